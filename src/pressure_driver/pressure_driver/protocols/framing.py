"""Consistent-overhead byte stuffing (Cheshire and Baker 1999) and CRC-16 for binary frames."""

from __future__ import annotations

import binascii

from cobs import cobs

from pressure_driver.protocols.pieces import StreamCutter

INITIAL = 0xFFFF


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, nothing reflected or inverted.

    Check value: ``crc16(b"123456789") == 0x29B1``.
    """
    return binascii.crc_hqx(data, INITIAL)


def stuff(data: bytes) -> bytes:
    """Return ``data`` coded without zero bytes; on the wire one zero byte ends it."""
    coded: bytes = cobs.encode(data)
    return coded


def unstuff(coded: bytes) -> bytes | None:
    """Return the data of a coded frame (without its ending zero), or None if it is damaged."""
    if not coded:
        return None
    try:
        data: bytes = cobs.decode(coded)
    except cobs.DecodeError:
        return None
    return data


class FrameSplitter:
    """Cuts a byte stream at zero bytes and checks each frame.

    Args:
        longest: coded bytes; longer frames are dropped as garbage.
    """

    def __init__(self, longest: int = 256) -> None:
        self._pieces = StreamCutter(b"\0", longest)
        self.rejected = 0

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Return (place of the first byte, payload without CRC) of every sound frame."""
        frames: list[tuple[int, bytes]] = []
        for start, coded in self._pieces.feed(data):
            if coded == b"":
                continue
            payload = None if coded is None else _open(coded)
            if payload is None:
                self.rejected += 1
            else:
                frames.append((start, payload))
        return frames

    def reset(self) -> None:
        """Forget a half-received frame."""
        self._pieces.reset()


def _open(coded: bytes) -> bytes | None:
    data = unstuff(coded)
    if data is None or len(data) < 3:
        return None
    payload, check = data[:-2], data[-2:]
    return payload if crc16(payload).to_bytes(2, "little") == check else None


def seal(payload: bytes) -> bytes:
    """Return the wire bytes of a payload: CRC appended (low byte first), stuffed, ended by zero."""
    return stuff(payload + crc16(payload).to_bytes(2, "little")) + b"\0"
