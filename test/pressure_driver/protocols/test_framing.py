"""Frames of the native protocol: damage is found, splits and garbage do no harm."""

import crcmod.predefined
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


def test_the_checksum_is_that_of_an_independent_implementation():
    independent = crcmod.predefined.mkCrcFun("crc-ccitt-false")
    assert crc16(b"123456789") == 0x29B1
    for length in (0, 1, 255, 256, 600):
        data = bytes(place * 7 % 256 for place in range(length))
        assert crc16(data) == independent(data)


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
    splitter, pieces = FrameSplitter(), []
    for start in range(0, len(stream), chunk):
        pieces += splitter.feed(stream[start : start + chunk])
    got = [(place, frame) for place, frame in pieces if frame]
    assert [frame for _, frame in got] == [
        Frame(FrameType.VENT, n, body) for n, body in enumerate(bodies)
    ]
    assert len(pieces) == len(got) + len(bodies) + 1
    for place, frame in got:
        sealed = encode(frame.type, frame.sequence, frame.body)
        assert stream[place : place + len(sealed)] == sealed
