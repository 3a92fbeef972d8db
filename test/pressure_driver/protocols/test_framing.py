"""Byte stuffing and checksum against independent implementations."""

import crcmod.predefined
import numpy as np
import pytest

from pressure_driver.protocols.native import (
    Frame,
    FrameSplitter,
    FrameType,
    crc16,
    encode,
    seal,
    unseal,
)


def samples():
    generator = np.random.default_rng(1)
    yield b""
    yield b"\0"
    for length in (1, 2, 251, 252, 253, 254, 255, 256, 508, 600):
        yield bytes(length)
        yield b"\x07" * length
        yield b"\0" + b"\xff" * length
    for _ in range(300):
        data = generator.integers(0, 256, generator.integers(1, 700), dtype=np.uint8)
        data[generator.random(len(data)) < generator.random()] = 0
        yield data.tobytes()


def stuffed_by_definition(data):
    """Cheshire and Baker (1999), byte by byte: a length, then up to 254 bytes that follow it."""
    out, block = b"", b""
    for place, byte in enumerate(data):
        if byte:
            block += bytes([byte])
        if not byte or (len(block) == 254 and place < len(data) - 1):
            out, block = out + bytes([len(block) + 1]) + block, b""
    return out + bytes([len(block) + 1]) + block


def test_sealing_is_what_the_definitions_say():
    independent = crcmod.predefined.mkCrcFun("crc-ccitt-false")
    assert crc16(b"123456789") == 0x29B1
    for data in samples():
        check = independent(data).to_bytes(2, "little")
        assert seal(data) == stuffed_by_definition(data + check) + b"\0"
        assert unseal(seal(data)[:-1]) == data


def test_every_single_bit_error_is_found():
    frame = seal(bytes(range(1, 30)))[:-1]
    for bit in range(8 * len(frame)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        assert unseal(bytes(damaged)) is None


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_frames_survive_any_split_and_garbage_between_them(chunk):
    bodies = [bytes([n, 0, n, 255]) * (n + 1) for n in range(20)]
    stream = (
        b"\x01" * 10_000
        + b"\0"
        + b"".join(encode(FrameType.VENT, n, body) + b"\x05no\0" for n, body in enumerate(bodies))
    )
    splitter, got = FrameSplitter(), []
    for start in range(0, len(stream), chunk):
        got += splitter.feed(stream[start : start + chunk])
    assert [frame for _, frame in got] == [
        Frame(FrameType.VENT, n, body) for n, body in enumerate(bodies)
    ]
    assert splitter.rejected == len(bodies) + 1
    for place, frame in got:
        sealed = encode(frame.type, frame.sequence, frame.body)
        assert stream[place : place + len(sealed)] == sealed
