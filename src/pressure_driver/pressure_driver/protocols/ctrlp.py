r"""The open Ctrl-P board: semicolon commands at 115200 baud, gauge pressures.

To the board, one command a line::

    ECHO;1   UNITS;1 (kPa)   MODE;3 (ramps)   TIME;50 (ms between reports)   ON (reports)
    SET;0.050;7.500;0.000;0.000;7.500     seconds to ramp, then one gauge pressure a channel

From the board, lines of ms since boot, a kind, and gauge pressures, separated by tabs::

    12345<TAB>0<TAB>7.50<TAB>0.00<TAB>0.00<TAB>7.50      what the channels are regulated to
    12345<TAB>1<TAB>7.48<TAB>0.00<TAB>-0.01<TAB>7.50     what is measured there
    12345<TAB>2<TAB>140.00                               the supply, if a sensor is fitted

and echoes of commands, which begin with an underscore: ``_NEW SET: 0.05<TAB>7.50<TAB>…``,
``_NEW UNITS: kPa<TAB>kPa`` (of commands and of reports; older boards may repeat the number),
``_UNREC: …``. A board that cuts a SET at its own limit (MAXP) does not follow. Each channel is
regulated on its own, so both chambers of a pair are named. There is no checksum and no watchdog. A
board that has measured more than its limit vents until the next MODE.

After a reset the board works in psi, which would make a setpoint in kPa 6.9 times too high, and
does not report. So the settings are sent again after every sign of a reset (the board's clock goes
back, it sends words that are no echo, it has been silent) and at every arming, and no pressure is
commanded before the board has repeated the units.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence

from pressure_driver.protocols import BoardReset, BoardText, Echo, Event, LineHost, Telemetry

PASCAL_PER_KILOPASCAL = 1000.0
LARGEST_GAUGE = 500.0
"""[kPa] More is a damaged line."""
RAMP_TIME = 0.05
"""[s] in which the board moves from one setpoint to the next: one tick."""

_NUMBERS = r"(?:\t-?(?:\d{1,4}(?:\.\d{1,6})?|nan|inf))+"
"""Firmware prints nan or inf for a sensor that is broken: the driver judges that."""
_REPORT = re.compile(r"\d{1,10}\t[012]" + _NUMBERS)
_ECHO = re.compile(r"(?:NEW )?(?:SET|UNITS|MODE|TIME|ECHO|ON|OFF|UNREC)\b")
_UNITS_ECHO = re.compile(r"(?:NEW )?UNITS:?(?:\s+(?:1(?:\.0*)?|kPa)){1,2}\s*", re.IGNORECASE)
_UNITS_UNKNOWN = "the board has not confirmed that it works in kPa"


class CtrlpHost(LineHost):
    """The driver's end of ``ctrlp``."""

    name = "ctrlp"
    weaknesses = (
        "no watchdog: if this computer dies, the board keeps the last pressures",
        "no checksum: a damaged number can pass for a pressure",
        "the supply pressure is not reported by boards without a sensor for it",
    )
    echoes = True
    reach = LARGEST_GAUGE * PASCAL_PER_KILOPASCAL

    def doubt(self) -> None:
        """Have the units confirmed again before the next setpoint."""
        self.unsettled = _UNITS_UNKNOWN

    def reset(self) -> None:
        """Forget a half-received line and everything that the board has confirmed."""
        super().reset()
        self._times = deque[int](maxlen=4)
        self.doubt()

    def start(self) -> bytes:
        """Echoes on, kPa, ramps between setpoints, reports at 20 Hz."""
        return b"\nECHO;1\nUNITS;1\nMODE;3\nTIME;50\nON\n"

    def setpoint(self, gauge: Sequence[float]) -> bytes:
        """Encode one gauge pressure a channel in kPa, to 1 Pa."""
        numbers = ";".join(f"{value / PASCAL_PER_KILOPASCAL:.3f}" for value in gauge)
        return f"SET;{RAMP_TIME:.3f};{numbers}\n".encode()

    def vent(self) -> bytes:
        """Zero gauge pressure on every channel, without a ramp."""
        return ("SET;0.000" + ";0.000" * self.chamber_count + "\n").encode()

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
            return self._parse_words(line) if words else None
        time, kind, *parts = line.split("\t")
        values = [float(part) for part in parts]
        expected = 1 if kind == "2" else self.chamber_count
        if len(values) != expected or any(abs(value) > LARGEST_GAUGE for value in values):
            return None
        # A board whose clock stands still repeats itself.
        stands_still = len(self._times) == 4 and {int(time), *self._times} == {int(time)}
        if kind == "0" or (kind == "1" and stands_still):
            return Telemetry()  # sound, and nothing that was measured
        pressure = tuple(
            self.assumed_atmosphere + value * PASCAL_PER_KILOPASCAL for value in values
        )
        if kind == "2":
            return Telemetry(supply_pressure=pressure[0])
        self._times.append(int(time))
        return Telemetry(chamber_pressure=pressure)

    def _parse_echo(self, text: str) -> Event:
        if text.startswith("NEW SET"):
            return Echo()
        if _UNITS_ECHO.fullmatch(text):
            self.unsettled = ""
        elif "UNITS" in text:
            self.unsettled = f"{_UNITS_UNKNOWN}: it answers '{text}'"
        return BoardText(text) if _ECHO.match(text) else self._parse_words(text)

    def _parse_words(self, text: str) -> Event:
        """Words that are no echo come from a board that starts; tabs are left by damaged lines."""
        if self.unsettled or "\t" in text:
            return BoardText(text)
        self.doubt()
        return BoardReset("it sends words, as it does while it boots")
