"""The boards' own ends of the protocols: for the emulator, and a reference for firmware."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterator, Sequence

from pressure_driver.emulator import BoardCommand, BoardProtocol, BoardReading
from pressure_driver.emulator.polled import FestoBoard, PneudriveBoard
from pressure_driver.protocols import cut_at, cut_lines
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

UNITS = {"psi": 6894.757, "kPa": PASCAL_PER_KILOPASCAL}
"""[Pa] Units of a ctrlp board by the number of the command UNITS; it starts with psi."""
LONGEST_LIST = 200
"""[bytes] that an ezloop board takes for one command."""
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


BOARDS: dict[str, type[BoardProtocol]] = {
    "ezloop": EzloopBoard,
    "ctrlp": CtrlpBoard,
    "native": NativeBoard,
    "festo": FestoBoard,
    "pneudrive": PneudriveBoard,
}
"""The board's end of each protocol."""
