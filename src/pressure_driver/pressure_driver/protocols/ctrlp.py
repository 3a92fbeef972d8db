r"""The open Ctrl-P board: semicolon commands at 115200 baud, gauge pressures.

To the board, one command a line::

    ECHO;1   UNITS;1 (kPa)   MODE;3 (ramps)   TIME;50 (ms between reports)   ON (reports)
    SET;0.050;7.500;0.000;0.000;7.500     seconds to ramp, then one gauge pressure a channel

From the board, one report a line, numbers separated by tabs::

    12345<TAB>1<TAB>7.481<TAB>0.002<TAB>-0.003<TAB>7.502     ms since boot, 1, gauge pressures

and echoes of commands, which begin with an underscore (``_NEW SET: …``, ``_UNREC: …``). Each
channel is regulated on its own, so both chambers of a pair are named. There is no checksum and no
watchdog, and the board does not tell its supply.

After a reset the board works in psi, which would make a setpoint in kPa 6.9 times too high, and
does not report. So the settings are sent again after every sign of a reset (the board's clock goes
back, it sends words that are no echo, it has been silent), and no pressure is commanded before the
board has repeated the units.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence

from pressure_driver.protocols.base import (
    BoardCommand,
    BoardProtocol,
    BoardReading,
    BoardReport,
    BoardReset,
    BoardText,
    Echo,
    Event,
    Telemetry,
)
from pressure_driver.protocols.lines import LineHost, LineSplitter

PASCAL_PER_KILOPASCAL = 1000.0
PASCAL_PER_PSI = 6894.757
UNITS = {0: PASCAL_PER_PSI, 1: PASCAL_PER_KILOPASCAL}
"""[Pa] by the number of the command UNITS; a board starts with 0."""
LARGEST_GAUGE = 500.0
"""[kPa] More is a damaged line."""
RAMP_TIME = 0.05
"""[s] in which the board moves from one setpoint to the next: one tick."""

_REPORT = re.compile(r"\d{1,10}\t1(?:\t-?\d{1,4}(?:\.\d{1,6})?)+")
_ECHO = re.compile(r"(?:NEW )?(?:SET|UNITS|MODE|TIME|ECHO|ON|OFF)\b")
_UNITS_ECHO = re.compile(r"NEW UNITS:?\s*1(?:\.0*)?\s*")
_UNITS_UNKNOWN = "the board has not confirmed that it works in kPa"
_COMMAND = re.compile(r"[A-Z]{2,12}(?:;-?\d{1,6}(?:\.\d{1,6})?)*")


class CtrlpHost(LineHost):
    """The driver's end of ``ctrlp``."""

    name = "ctrlp"
    weaknesses = (
        "no watchdog: if this computer dies, the board keeps the last pressures",
        "no checksum: a damaged number can pass for a pressure",
        "the supply pressure is not reported",
    )
    echoes = True

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self.unsettled = _UNITS_UNKNOWN
        self._times: deque[int] = deque(maxlen=4)

    def doubt(self) -> None:
        """Have the units confirmed again before the next setpoint."""
        self.unsettled = _UNITS_UNKNOWN

    def reset(self) -> None:
        """Forget a half-received line and everything that the board has confirmed."""
        super().reset()
        self._times.clear()
        self.doubt()

    def start(self) -> bytes:
        """Echoes on, kPa, ramps between setpoints, reports at 20 Hz."""
        return b"\nECHO;1\nUNITS;1\nMODE;3\nTIME;50\nON\n"

    def setpoint(
        self,
        differential: Sequence[float],
        atmosphere: float,  # noqa: ARG002 - the wire carries gauge pressures
        valid_for: float,  # noqa: ARG002 - the board has no watchdog
    ) -> tuple[bytes, int | None]:
        """Encode one gauge pressure a channel in kPa, to 1 Pa.

        Raises:
            ValueError: wrong number of segments, or a value that the wire cannot carry.
        """
        self._check_segments(differential)
        values: list[float] = []
        for difference in differential:
            size = abs(difference) / PASCAL_PER_KILOPASCAL
            if not size <= LARGEST_GAUGE:
                raise ValueError(f"a difference of {difference} Pa does not fit a ctrlp command")
            values += [size, 0.0] if difference >= 0.0 else [0.0, size]
        numbers = ";".join(f"{value:.3f}" for value in values)
        return f"SET;{RAMP_TIME:.3f};{numbers}\n".encode(), None

    def vent(self, atmosphere: float) -> tuple[bytes, int | None]:  # noqa: ARG002
        """Zero gauge pressure on every channel, without a ramp."""
        return ("SET;0.000" + ";0.000" * self.chamber_count + "\n").encode(), None

    def decode(self, data: bytes) -> list[Event]:
        """Return what complete lines say; a clock that has gone back is a reset."""
        events = super().decode(data)
        if self._clock_went_back():
            self._times.clear()
            self.doubt()
            events.append(BoardReset("its clock has gone back"))
        return events

    def _clock_went_back(self) -> bool:
        """Tell whether the last two reports are older than each of the two before.

        Two and two, since one may be a damaged number: nothing protects the digits.
        """
        if len(self._times) < 4:
            return False
        first, second, third, last = self._times
        return third <= last < min(first, second)

    def _parse(self, line: str) -> Event | None:
        if line.startswith("_"):
            return self._parse_echo(line[1:])
        if not _REPORT.fullmatch(line):
            # Words are free text; digits and tabs are the rest of a damaged report.
            words = any(character.isalpha() for character in line) and "\t" not in line
            return self._take_text(line) if words else None
        values = [float(part) for part in line.split("\t")[2:]]
        if len(values) != self.chamber_count or max(map(abs, values)) > LARGEST_GAUGE:
            return None
        self._times.append(int(line.split("\t", 1)[0]))
        return Telemetry(
            chamber_pressure=tuple(
                self.assumed_atmosphere + value * PASCAL_PER_KILOPASCAL for value in values
            )
        )

    def _parse_echo(self, text: str) -> Event:
        if text.startswith("NEW SET"):
            return Echo()
        if text.startswith("UNREC"):
            return BoardReport("a command was not understood", fatal=False)
        if _UNITS_ECHO.fullmatch(text):
            self.unsettled = ""
        return BoardText(text) if _ECHO.match(text) else self._take_text(text)

    def _take_text(self, text: str) -> Event:
        """Words that are no echo come from a board that starts; tabs are left by damaged lines."""
        if self.unsettled or "\t" in text:
            return BoardText(text)
        self.doubt()
        return BoardReset("it sends words, as it does while it boots")


class CtrlpBoard(BoardProtocol):
    """The firmware's end of ``ctrlp``."""

    gauge = True

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self._lines = LineSplitter()
        self._malformed = 0
        self._reports = False
        self._echoes = True
        self._unit = PASCAL_PER_PSI

    def boot(self, atmosphere: float) -> bytes:  # noqa: ARG002 - it measures gauge pressure
        """Reports are off until asked for, and pressures are in psi."""
        self._unit = PASCAL_PER_PSI
        self._reports = False
        self._echoes = True
        return b"_pressure controller\n"

    def decode(self, data: bytes) -> list[BoardCommand]:
        """Return the commands of complete lines; the board understands small letters, too."""
        commands = []
        for place, line in self._lines.feed(data):
            commands.append(self._parse(place, line.upper()))
        self.rejected = self._malformed + self._lines.damaged
        return commands

    def _parse(self, place: int, line: str) -> BoardCommand:
        if _COMMAND.fullmatch(line):
            word, *arguments = line.split(";")
            numbers = [float(argument) for argument in arguments]
            if word in ("ON", "OFF"):
                self._reports = word == "ON"
                return BoardCommand("outputs", place, text=line)
            if word == "ECHO" and numbers:
                self._echoes = numbers[0] != 0.0
                return BoardCommand("echo", place, text=line)
            if word == "UNITS" and numbers and numbers[0] in UNITS:
                self._unit = UNITS[int(numbers[0])]
                return BoardCommand("setting", place, text=line)
            if word in ("MODE", "TIME") and numbers:
                return BoardCommand("setting", place, text=line)
            if word == "SET" and len(numbers) == self.chamber_count + 1:
                pressure = tuple(value * self._unit for value in numbers[1:])
                return BoardCommand("setpoint", place, pressure=pressure, text=line)
        self._malformed += 1
        return BoardCommand("unknown", place, text=line)

    def telemetry(self, reading: BoardReading) -> bytes:
        """One report line, if reports are on."""
        if not self._reports:
            return b""
        values = "\t".join(
            f"{(p - reading.atmosphere) / self._unit:.3f}" for p in reading.chamber_pressure
        )
        return f"{round(reading.time * 1000.0)}\t1\t{values}\n".encode()

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:  # noqa: ARG002
        """The echo."""
        if not self._echoes:
            return b""
        if command.kind == "unknown":
            return b"_UNREC: Unrecognized Command\n"
        new = "NEW " if command.kind in ("setpoint", "setting") else ""
        word, _, rest = command.text.partition(";")
        return f"_{new}{word}: {rest}\n".replace(";", "\t").encode()
