"""The boards' own ends of the protocols: for the emulator, and a reference for firmware."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence

from pressure_driver.emulator import BoardCommand, BoardProtocol, BoardReading
from pressure_driver.following import Duration
from pressure_driver.protocols import cut_at, cut_lines, festo
from pressure_driver.protocols.ctrlp import PASCAL_PER_KILOPASCAL
from pressure_driver.protocols.ezloop import LARGEST_WIRE_VALUE, PASCAL_PER_HECTOPASCAL, numbers_of
from pressure_driver.protocols.native import (
    IDENTITY_HEAD,
    LONGEST_VALIDITY,
    SETPOINT_HEAD,
    STATUS_HEAD,
    FaultCode,
    Frame,
    FrameType,
    StatusFlag,
    cut_frames,
    encode,
)
from pressure_driver.protocols.pneudrive import PneudriveEnd
from pressure_driver.settings import EmulatorSettings

UNITS = {"psi": 6894.757, "kPa": PASCAL_PER_KILOPASCAL}
"""[Pa] Units of a ctrlp board by the number of the command UNITS; it starts with psi."""
LONGEST_LIST = 200
"""[bytes] that an ezloop board takes for one command."""
BUS_PATIENCE = 1.0
"""[s] without a write, after which a terminal takes the bus for lost and resets its outputs."""
SLOT_START_TIME = 1.5
"""[s] from the mode to a slot that runs."""
PNEUDRIVE_BOOT_TIME = 2.0
"""[s] for which a PneuDrive board vents at its start, whatever it is told."""
NOT_READY, TO_BE_CONFIGURED = 0, 1
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS = 1, 2
"""Exceptions of Modbus."""
_COMMAND = re.compile(r"[A-Z]{2,12}(?:;-?\d{1,6}(?:\.\d{1,6})?)*")


class EzloopBoard(BoardProtocol):
    """The firmware's end of ``ezloop``."""

    def boot(self, atmosphere: float) -> bytes:
        """Free text, as boards print it while they start."""
        return (
            f"valve board, {self.chamber_count} chambers\r\n"
            f"room pressure {atmosphere / PASCAL_PER_HECTOPASCAL:.2f} hPa\r\nready\r\n"
        ).encode()

    def _cut(self) -> list[bytes | None]:
        return cut_at(b">", LONGEST_LIST, self._kept)

    def _interpret(self, piece: bytes) -> list[BoardCommand]:
        """Return what stands between ``<`` and ``>``, if it is a list of admissible numbers."""
        _, bracket, body = piece.rpartition(b"<")
        values = numbers_of(body.decode("latin-1"), ",")
        if not bracket or values is None or len(values) != self.chamber_count:
            return []
        if not all(math.isfinite(value) and value <= LARGEST_WIRE_VALUE for value in values):
            return []
        pressure = tuple(value * PASCAL_PER_HECTOPASCAL for value in values)
        return [BoardCommand("setpoint", pressure)]

    def telemetry(self, reading: BoardReading) -> bytes:
        """Three lines: chambers, reservoir, valves."""
        chambers = " ".join(f"{p / PASCAL_PER_HECTOPASCAL:.2f}" for p in reading.chamber_pressure)
        valves = " ".join(f"{v:.2f}" for v in reading.valve_opening)
        supply = reading.supply_pressure / PASCAL_PER_HECTOPASCAL
        return f"[MPR]: {chambers}\r\n[RPR]: {supply:.2f}\r\n[VAL]: {valves}\r\n".encode()


class CtrlpBoard(BoardProtocol):
    """The firmware's end of ``ctrlp``."""

    gauge = True

    def boot(self, atmosphere: float) -> bytes:  # noqa: ARG002 - it measures gauge pressure
        """Reports are off until asked for, and pressures are in psi."""
        self._unit = "psi"
        self._setpoint = (0.0,) * self.chamber_count
        self._reports = False
        return b"_pressure controller\n"

    def _cut(self) -> Iterator[str | None]:
        return cut_lines(self._kept)

    def _interpret(self, line: str) -> list[BoardCommand]:
        line = line.upper()  # the board understands small letters, too
        if _COMMAND.fullmatch(line):
            word, *arguments = line.split(";")
            numbers = [float(argument) for argument in arguments]
            if word in ("ON", "OFF"):
                self._reports = word == "ON"
                return [BoardCommand("outputs", text=line)]
            if word == "ECHO":
                return [BoardCommand("echo", text=line)]
            if word in ("MODE", "TIME") and numbers:
                return [BoardCommand("setting", text=line)]
            if word == "UNITS" and numbers and numbers[0] in range(len(UNITS)):
                self._unit = list(UNITS)[int(numbers[0])]
                return [BoardCommand("setting", text=line)]
            if word == "SET" and len(numbers) == self.chamber_count + 1:
                self._setpoint = tuple(value * UNITS[self._unit] for value in numbers[1:])
                return [BoardCommand("setpoint", self._setpoint, text=line)]
        self.rejected += 1
        return [BoardCommand("unknown", text=line)]

    def telemetry(self, reading: BoardReading) -> bytes:
        """The lines of one report, if reports are on: setpoints and measured pressures."""
        if not self._reports:
            return b""
        time = round(reading.time * 1000.0)
        gauge = [p - reading.atmosphere for p in reading.chamber_pressure]
        return (
            f"{time}\t0\t{self._in_units(self._setpoint)}\r\n{time}\t1\t{self._in_units(gauge)}\r\n"
        ).encode()

    def _in_units(self, pressure: Sequence[float]) -> str:
        return "\t".join(f"{value / UNITS[self._unit]:.2f}" for value in pressure)

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:  # noqa: ARG002
        """The echo."""
        if command.kind == "unknown":
            return b"_UNREC: Unrecognized Command\r\n"
        new = "NEW " if command.kind in ("setpoint", "setting") else ""
        word, _, rest = command.text.partition(";")
        if command.pressure is not None:
            rest = f"{float(rest.partition(';')[0]):.2f}\t{self._in_units(command.pressure)}"
        elif word == "UNITS":
            rest = f"{self._unit}\t{self._unit}"
        return f"_{new}{word}: {rest}\r\n".replace(";", "\t").encode()


class NativeBoard(BoardProtocol):
    """The firmware's end of ``native``: a reference for authors of firmware."""

    gauge = True

    _FIRMWARE = b"emulator 1"

    def __init__(
        self,
        chamber_count: int = 4,
        largest_pressure: int = 1_000_000,
        known: int = StatusFlag.SUPPLY_KNOWN | StatusFlag.VALVES_KNOWN,
    ) -> None:
        super().__init__(chamber_count)
        self._known = known
        self._largest = largest_pressure

    def _cut(self) -> list[Frame | None]:
        return cut_frames(self._kept)

    def _interpret(self, frame: Frame) -> list[BoardCommand]:
        """Return HELLO, SETPOINT or VENT; a setpoint out of range comes back as ``refused``."""
        number, body = frame.sequence, frame.body
        if frame.type in (FrameType.HELLO, FrameType.VENT):
            kind = "hello" if frame.type is FrameType.HELLO else "vent"
            return [] if body else [BoardCommand(kind, sequence=number)]
        if frame.type is not FrameType.SETPOINT:
            return []
        if len(body) != SETPOINT_HEAD.size + 4 * self.chamber_count:
            return [BoardCommand("refused", sequence=number, text="wrong length")]
        (milliseconds,) = SETPOINT_HEAD.unpack_from(body)
        values = struct.unpack_from(f"<{self.chamber_count}i", body, SETPOINT_HEAD.size)
        if not 0 < milliseconds <= LONGEST_VALIDITY:
            return [BoardCommand("refused", sequence=number, text="valid-for out of range")]
        if min(values) < 0 or max(values) > self._largest:
            return [BoardCommand("refused", sequence=number, text="pressure out of range")]
        pressure = tuple(float(value) for value in values)
        return [BoardCommand("setpoint", pressure, milliseconds / 1000.0, number)]

    def telemetry(self, reading: BoardReading) -> bytes:
        """One STATUS frame."""
        flags = self._known
        flags |= StatusFlag.VENTED if reading.vented else 0
        flags |= StatusFlag.EXPIRED if reading.expired else 0
        atmosphere = round(reading.atmosphere)
        body = STATUS_HEAD.pack(
            round(reading.time * 1000.0) & 0xFFFFFFFF,
            reading.last_sequence,
            flags,
            atmosphere,
            round(reading.supply_pressure),
        )
        for pressure in reading.chamber_pressure:
            body += struct.pack("<i", round(pressure) - atmosphere)
        body += bytes(round(255 * min(max(v, 0.0), 1.0)) for v in reading.valve_opening)
        return encode(FrameType.STATUS, self._next(), body)

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:
        """IDENTITY to HELLO, FAULT to what was refused, STATUS to everything else."""
        if command.kind == "hello":
            body = IDENTITY_HEAD.pack(
                self.chamber_count, 0, self._largest, round(reading.atmosphere), len(self._FIRMWARE)
            )
            return encode(FrameType.IDENTITY, self._next(), body + self._FIRMWARE)
        if command.kind == "refused":
            return self.fault(FaultCode.REFUSED, command.text)
        return self.telemetry(reading)

    def fault(self, code: int, text: str) -> bytes:
        """One FAULT frame."""
        return encode(FrameType.FAULT, self._next(), bytes([code]) + text.encode("ascii"))

    def expired(self) -> bytes:
        """What the board says when it has vented since no setpoint came in time."""
        return self.fault(FaultCode.EXPIRED, "no setpoint in time, vented")


class Slot:
    """Two valves of a motion terminal: they regulate once they have been started."""

    def __init__(self) -> None:
        self.mode = 0
        self.state = TO_BE_CONFIGURED
        self._starting = Duration()

    def tell(self, word: int) -> None:
        """Take over the first register of the slot."""
        mode, control = word & 0x3F, word >> 6 & 3
        if mode in (festo.ACKNOWLEDGE, festo.INACTIVE):
            self.mode, self.state = festo.INACTIVE, TO_BE_CONFIGURED
        elif (mode, control, self.mode) == (festo.REGULATE, festo.BOTH_VALVES, festo.INACTIVE):
            self.mode, self.state = festo.REGULATE, NOT_READY

    def look(self, time: float) -> None:
        """Go on with the start (time since boot [s])."""
        self._starting.note(self.state == NOT_READY, time)
        if self._starting.until(time) >= SLOT_START_TIME:
            self.state = festo.RUNNING


class FestoBoard(BoardProtocol):
    """The terminal's end of ``festo``."""

    gauge = True
    _motion_terminal = True

    def configure(self, settings: EmulatorSettings) -> None:
        """Take over which valves the terminal has."""
        self._motion_terminal = settings.terminal == "vtem"
        self.boot(0.0)

    def boot(self, atmosphere: float) -> bytes:  # noqa: ARG002 - the wire has gauge pressures
        """All registers are zero, and slots have to be started."""
        self.slots = [Slot() for _ in range(self.chamber_count // 2 * self._motion_terminal)]
        self._outputs = [0] * (3 * len(self.slots) or self.chamber_count)
        return b""

    def _cut(self) -> Iterator[festo.ModbusFrame | None]:
        return festo.cut_frames(self._kept)

    def _interpret(self, frame: festo.ModbusFrame) -> list[BoardCommand]:
        """Return a read or a write; what is not there comes back as ``refused``."""
        function, data, number = frame.function, frame.data, frame.transaction
        first, count = festo.BLOCK.unpack(data[:4].ljust(4, b"\0"))
        if function == festo.READ:
            return [BoardCommand("read", sequence=number, text=f"{first} {count}")]
        words, offset = festo.to_words(data[5:]), first - festo.FIRST_OUTPUT
        inside = 0 <= offset <= len(self._outputs) - count
        if function == festo.WRITE and inside and len(words) == count:
            self._outputs[offset : offset + count] = words
            for slot, word in zip(self.slots, self._outputs[0::3], strict=False):
                slot.tell(word)
            told = self._setpoints()
            return [BoardCommand("setpoint", told, BUS_PATIENCE, number, f"{first} {count}")]
        self.rejected += 1
        problem = ILLEGAL_ADDRESS if function == festo.WRITE else ILLEGAL_FUNCTION
        return [BoardCommand("refused", sequence=number, text=f"{function} {problem}")]

    def _setpoints(self) -> tuple[float, ...]:
        values = [v for place, v in enumerate(self._outputs) if place % 3 or not self.slots]
        return tuple(festo.PASCAL_PER_MILLIBAR * value for value in values)

    def target(self, pressure: Sequence[float], time: float) -> Sequence[float]:
        """Return setpoints of slots that run; the others are vented."""
        if not self.slots:
            return pressure
        for slot in self.slots:
            slot.look(time)
        return [
            value if self.slots[chamber // 2].state == festo.RUNNING else 0.0
            for chamber, value in enumerate(pressure)
        ]

    def _inputs(self, reading: BoardReading) -> list[int]:
        gauge = (pressure - reading.atmosphere for pressure in reading.chamber_pressure)
        measured = [round(value / festo.PASCAL_PER_MILLIBAR) for value in gauge]
        if not self.slots:
            pairs = zip(measured, self._outputs, strict=True)
            return [word for value, told in pairs for word in (value, told, 0)]
        words: list[int] = []
        for place, slot in enumerate(self.slots):
            slot.look(reading.time)
            words += [festo.slot_word(slot.mode, slot.state), *measured[2 * place : 2 * place + 2]]
        return words

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:
        """Registers to a read, first register and their number to a write, else an exception."""
        number, (first, second) = command.sequence or 0, map(int, command.text.split())
        if command.kind == "refused":
            return festo.encode(number, first | festo.FAILED, bytes([second]))
        if command.kind == "setpoint":
            return festo.encode(number, festo.WRITE, festo.BLOCK.pack(first, second))
        words, offset = self._inputs(reading), first - festo.FIRST_INPUT
        if not 0 <= offset <= len(words) - second:
            return festo.encode(number, festo.READ | festo.FAILED, bytes([ILLEGAL_ADDRESS]))
        data = festo.to_bytes(words[offset : offset + second])
        return festo.encode(number, festo.READ, bytes([len(data)]) + data)

    def expired(self) -> bytes:
        """The bus is lost: all outputs are zero, and slots have to be started again."""
        return self.boot(0.0)


class PneudriveBoard(PneudriveEnd, BoardProtocol):
    """The board's end of ``pneudrive``."""

    gauge = True

    def _interpret(self, gauge: tuple[float, ...]) -> list[BoardCommand]:
        """Return targets."""
        return [BoardCommand("setpoint", gauge)]

    def target(self, pressure: Sequence[float], time: float) -> Sequence[float]:
        """Return the targets; nothing while the board starts."""
        return pressure if time >= PNEUDRIVE_BOOT_TIME else [0.0] * len(pressure)

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:  # noqa: ARG002
        """What the board measures, in the layout of its targets."""
        return self.encode([p - reading.atmosphere for p in reading.chamber_pressure])


BOARDS: dict[str, type[BoardProtocol]] = {
    "ezloop": EzloopBoard,
    "ctrlp": CtrlpBoard,
    "native": NativeBoard,
    "festo": FestoBoard,
    "pneudrive": PneudriveBoard,
}
"""The board's end of each protocol."""
