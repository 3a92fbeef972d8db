"""The frames of Modbus TCP that a valve terminal needs: registers are read and written in blocks.

A frame is ``transaction u16, 0 u16, length u16, unit u8, function u8, data``, all big-endian; the
length counts what follows it. (Modbus Messaging on TCP/IP Implementation Guide V1.0b.) Register
numbers are those on the wire, which count from 0, as in libmodbus.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import NamedTuple

from pressure_driver.protocols import FrameBuffer

HEADER = struct.Struct(">HHHBB")
BLOCK = struct.Struct(">HH")
UNIT = 0xFF
"""What is spoken to is the server itself, and no device behind it."""
READ = 3
WRITE = 16
FAILED = 0x80
"""Added to the function in the answer to a request that is refused."""
LONGEST_LENGTH = 254
"""[bytes] of unit, function and data."""
LENGTH_BEGINS = 6
"""[bytes] before those that the length counts."""


class ModbusFrame(NamedTuple):
    """One request or answer."""

    transaction: int
    function: int
    data: bytes


def encode(transaction: int, function: int, data: bytes) -> bytes:
    """Return the bytes of a frame."""
    return HEADER.pack(transaction & 0xFFFF, 0, len(data) + 2, UNIT, function) + data


def to_bytes(words: Iterable[int]) -> bytes:
    """Return registers as they are sent; negative numbers as their two's complement."""
    return b"".join((word & 0xFFFF).to_bytes(2, "big") for word in words)


def to_words(data: bytes) -> tuple[int, ...]:
    """Return registers, 0 … 65535; half a register at the end is left out."""
    return struct.unpack_from(f">{len(data) // 2}H", data)


def signed(word: int) -> int:
    """Return a register as a number of 16 bits with sign."""
    return word - 0x10000 if word & 0x8000 else word


class ModbusReader(FrameBuffer):
    """Cuts a byte stream into frames.

    TCP loses and changes nothing. What does not begin as a frame is skipped to where one may begin.
    """

    def feed(self, data: bytes) -> list[tuple[int, ModbusFrame]]:
        """Return (place of the first byte, frame) of those that became complete."""
        frames: list[tuple[int, ModbusFrame]] = []
        self.kept += data
        while len(self.kept) >= HEADER.size:
            transaction, zero, length, _, function = HEADER.unpack_from(self.kept)
            if zero or not 2 < length <= LONGEST_LENGTH:
                # The two zero bytes stand behind the transaction.
                self.skip_to(self.kept.find(b"\0\0", 3) - 2)
                continue
            if len(self.kept) < LENGTH_BEGINS + length:
                break
            place, frame = self.position, self.take(LENGTH_BEGINS + length)
            frames.append((place, ModbusFrame(transaction, function, frame[HEADER.size :])))
        return frames
