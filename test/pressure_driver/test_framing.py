"""Byte stuffing and checksum against independent implementations."""

import crcmod.predefined
import numpy as np
import pytest
from cobs import cobs

from pressure_driver.protocols.framing import FrameSplitter, crc16, seal, stuff, unstuff


def samples():
    generator = np.random.default_rng(1)
    yield b""
    yield b"\0"
    for length in (1, 2, 253, 254, 255, 256, 508, 509, 600):
        yield bytes(length)
        yield b"\x07" * length
        yield b"\x07" * length + b"\0"
        yield b"\0" + b"\xff" * length
    for _ in range(300):
        data = generator.integers(0, 256, generator.integers(1, 700), dtype=np.uint8)
        data[generator.random(len(data)) < generator.random()] = 0
        yield data.tobytes()


def test_stuffing_agrees_with_an_independent_package():
    for data in samples():
        coded = stuff(data)
        assert coded == cobs.encode(data)
        assert 0 not in coded
        assert unstuff(coded) == data


def test_unstuffing_accepts_and_refuses_what_an_independent_package_does():
    generator = np.random.default_rng(2)
    outcomes = set()
    for _ in range(3000):
        coded = generator.integers(0, 12, generator.integers(1, 14), dtype=np.uint8).tobytes()
        try:
            expected = cobs.decode(coded)
        except cobs.DecodeError:
            expected = None
        outcomes.add(expected is None)
        assert unstuff(coded) == expected, coded.hex()
    assert outcomes == {True, False}


def test_checksum_agrees_with_an_independent_package():
    independent = crcmod.predefined.mkCrcFun("crc-ccitt-false")
    assert crc16(b"123456789") == 0x29B1
    for data in samples():
        assert crc16(data) == independent(data)


@pytest.mark.parametrize("chunk", [1, 2, 7, 1000])
def test_frames_survive_any_split_and_garbage_between_them(chunk):
    payloads = [bytes([n, 0, n, 255]) * (n + 1) for n in range(20)]
    stream = b"garbage\0" + b"".join(seal(p) + b"\x05no\0" for p in payloads)
    splitter = FrameSplitter()
    got = []
    for start in range(0, len(stream), chunk):
        got += splitter.feed(stream[start : start + chunk])
    assert [payload for _, payload in got] == payloads
    assert splitter.rejected == len(payloads) + 1
    for place, payload in got:
        assert stream[place : place + len(seal(payload))] == seal(payload)


def test_every_single_bit_error_is_found():
    frame = seal(bytes(range(1, 30)))
    for bit in range(8 * (len(frame) - 1)):
        damaged = bytearray(frame)
        damaged[bit // 8] ^= 1 << bit % 8
        assert FrameSplitter().feed(bytes(damaged)) == []


def test_an_endless_frame_is_dropped_and_the_next_one_is_read():
    splitter = FrameSplitter(longest=64)
    assert splitter.feed(b"\x01" * 10_000) == []
    assert [p for _, p in splitter.feed(b"\0" + seal(b"abc"))] == [b"abc"]
    assert splitter.rejected == 1
