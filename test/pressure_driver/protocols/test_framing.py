"""Byte stuffing and checksum against independent implementations."""

import crcmod.predefined
import numpy as np
import pytest

from pressure_driver.protocols.native import FrameSplitter, crc16, seal, stuff, unstuff


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


def stuffed_by_definition(data):
    """Cheshire and Baker (1999), byte by byte: a length, then up to 254 bytes that follow it."""
    out, block = b"", b""
    for place, byte in enumerate(data):
        if byte:
            block += bytes([byte])
        if not byte or (len(block) == 254 and place < len(data) - 1):
            out, block = out + bytes([len(block) + 1]) + block, b""
    return out + bytes([len(block) + 1]) + block


def test_stuffing_is_what_the_definition_says():
    for data in samples():
        coded = stuff(data)
        assert coded == stuffed_by_definition(data)
        assert 0 not in coded
        assert unstuff(coded) == data


def test_unstuffing_refuses_what_no_stuffing_makes():
    for coded in (b"", b"\0", b"\x05abc", b"\x03a\0", b"\x02a\xff", b"\x01\0\x01"):
        assert unstuff(coded) is None, coded.hex()
    generator = np.random.default_rng(2)
    outcomes = set()
    for _ in range(3000):
        coded = generator.integers(0, 12, generator.integers(1, 14), dtype=np.uint8).tobytes()
        data = unstuff(coded)
        outcomes.add(data is None)
        assert data is None or stuff(data) == coded, coded.hex()
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
