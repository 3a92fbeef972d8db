"""Our own protocol for new firmware: binary frames with a checksum and a watchdog on the board.

Frames are stuffed (Cheshire and Baker 1999) so that they hold no zero byte, and end with one.

The specification, for authors of firmware and with test vectors, is
docs/reference/native_protocol.md.
"""

from __future__ import annotations

import binascii
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

from cobs import cobs

from pressure_driver.protocols import (
    BoardFailure,
    BoardIdentity,
    BoardReset,
    BoardText,
    Echo,
    Event,
    HostProtocol,
    Telemetry,
    cut_at,
)

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

VERSION = 1
HEADER = struct.Struct("<BBH")
IDENTITY_HEAD = struct.Struct("<BiiIB")
SETPOINT_HEAD = struct.Struct("<H")
STATUS_HEAD = struct.Struct("<IHBII")
LONGEST_FRAME = 256
"""[bytes] as coded; a longer one is garbage."""
LONGEST_VALIDITY = 60_000
"""[ms] A setpoint may stay valid at most this long."""
_UNKNOWN = "the board has not introduced itself yet"


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, nothing reflected or inverted.

    Check value: ``crc16(b"123456789") == 0x29B1``.
    """
    return binascii.crc_hqx(data, 0xFFFF)


class FrameType(IntEnum):
    """Second byte of every frame; the top bit is set in what the board sends."""

    HELLO = 0x01
    SETPOINT = 0x02
    VENT = 0x03
    IDENTITY = 0x81
    STATUS = 0x82
    FAULT = 0x83


class StatusFlag(IntEnum):
    """Bits of a STATUS frame."""

    VENTED = 1
    EXPIRED = 2
    SUPPLY_KNOWN = 4
    VALVES_KNOWN = 8


class FaultCode(IntEnum):
    """First byte of a FAULT frame's body."""

    EXPIRED = 1
    OVER_PRESSURE = 2
    SENSOR = 3
    SUPPLY = 4
    REFUSED = 5


@dataclass(frozen=True)
class Frame:
    """A frame whose checksum and version are right."""

    type: FrameType
    sequence: int
    body: bytes


def seal(payload: bytes) -> bytes:
    """Return the wire bytes of a payload: CRC appended (low byte first), stuffed, ended by zero."""
    coded: bytes = cobs.encode(payload + crc16(payload).to_bytes(2, "little"))
    return coded + b"\0"


def encode(kind: FrameType, sequence: int, body: bytes = b"") -> bytes:
    """Return the wire bytes of a frame."""
    return seal(HEADER.pack(VERSION, kind, sequence & 0xFFFF) + body)


def cut_frames(kept: bytearray) -> list[Frame | None]:
    """Take complete frames; None for one that is damaged, of another version or unknown type."""
    return [_read(coded) for coded in cut_at(b"\0", LONGEST_FRAME, kept) if coded != b""]


def _read(coded: bytes | None) -> Frame | None:
    try:
        data: bytes = cobs.decode(coded or b"")
    except cobs.DecodeError:
        return None
    payload, check = data[:-2], data[-2:]
    if len(payload) < HEADER.size or crc16(payload).to_bytes(2, "little") != check:
        return None
    version, kind, sequence = HEADER.unpack_from(payload)
    if version != VERSION or kind not in set(FrameType):
        return None
    return Frame(FrameType(kind), sequence, payload[HEADER.size :])


class NativeHost(HostProtocol):
    """The driver's end of ``native``."""

    name = "native"
    reports_supply = True
    tells_pascals = True
    has_watchdog = True
    separator = b"\0"
    echoes = True

    _board_time: int | None

    def configure(self, settings: Settings) -> None:
        """Take over how long a command holds."""
        self._validity = round(1000.0 * settings.command_validity)

    def start(self) -> bytes:
        """A zero byte, which ends whatever was half-sent, and HELLO."""
        return b"\0" + encode(FrameType.HELLO, self._next())

    def setpoint(self, gauge: Sequence[float]) -> bytes:
        """Encode one gauge pressure a chamber, and how long they hold."""
        body = SETPOINT_HEAD.pack(self._validity)
        body += struct.pack(f"<{len(gauge)}i", *map(round, gauge))
        return encode(FrameType.SETPOINT, self._next(), body)

    def vent(self) -> bytes:
        """Encode VENT, which holds until the next SETPOINT."""
        return encode(FrameType.VENT, self._next())

    def _cut(self) -> list[Frame | None]:
        return cut_frames(self._kept)

    def _interpret(self, frame: Frame) -> list[Event]:
        if frame.type is FrameType.IDENTITY:
            return self._identity(frame.body)
        if frame.type is FrameType.STATUS:
            return self._status(frame.body)
        if frame.type is FrameType.FAULT and frame.body and frame.body[0] in set(FaultCode):
            code = FaultCode(frame.body[0])
            text = frame.body[1:].decode("ascii", "replace")
            name = code.name.lower().replace("_", "-")
            kind = BoardText if code is FaultCode.REFUSED else BoardFailure
            return [kind(f"{name}: {text}")]
        return []

    def _identity(self, body: bytes) -> list[Event]:
        if len(body) < IDENTITY_HEAD.size:
            return []
        count, low, high, _, length = IDENTITY_HEAD.unpack_from(body)
        text = body[IDENTITY_HEAD.size :]
        if len(text) != length or low > high:
            return []
        self.unsettled = ""
        return [BoardIdentity(count, float(high), text.decode("ascii", "replace"))]

    def _status(self, body: bytes) -> list[Event]:
        count = self.chamber_count
        if len(body) != STATUS_HEAD.size + 5 * count:
            return []
        time, echo, flags, atmosphere, supply = STATUS_HEAD.unpack_from(body)
        gauges = struct.unpack_from(f"<{count}i", body, STATUS_HEAD.size)
        valves = body[STATUS_HEAD.size + 4 * count :]
        telemetry = Telemetry(
            chamber_pressure=tuple(float(atmosphere + gauge) for gauge in gauges),
            valve_opening=(
                tuple(value / 255.0 for value in valves)
                if flags & StatusFlag.VALVES_KNOWN
                else None
            ),
            supply_pressure=float(supply) if flags & StatusFlag.SUPPLY_KNOWN else None,
        )
        return [*self._look_for_reset(time), telemetry, Echo(echo)]

    def _look_for_reset(self, time: int) -> list[Event]:
        """Compare the board's clock, which counts ms modulo 2^32, with that of the last STATUS."""
        last, self._board_time = self._board_time, time
        if last is None or (time - last) & 0xFFFFFFFF < 0x80000000:
            return []
        self.unsettled = _UNKNOWN
        return [BoardReset("its clock has gone back")]

    def reset(self) -> None:
        """Forget a half-received frame, the board's clock and that it has introduced itself."""
        super().reset()
        self.unsettled = _UNKNOWN
        self._board_time = None
