"""Both ends of every board protocol: bytes, splits, garbage, limits, a million random bytes."""

import numpy as np
import pytest

from pressure_driver.emulator import BoardReading
from pressure_driver.emulator.firmware import BOARDS, BUS_PATIENCE, NativeBoard
from pressure_driver.following import chamber_gauge
from pressure_driver.protocols import (
    NAMES,
    BoardFailure,
    BoardIdentity,
    BoardText,
    SettingError,
    Telemetry,
    host_protocol,
)
from pressure_driver.protocols.native import FrameType, crc16, encode, seal
from pressure_driver.settings import Settings

ATMOSPHERE = 101_812.0
READING = BoardReading(
    time=12.345,
    chamber_pressure=(101_900.0, 109_322.0, 101_850.0, 101_840.0),
    atmosphere=ATMOSPHERE,
    valve_opening=(0.0, 0.25, 1.0, 0.5),
    supply_pressure=140_020.0,
    last_sequence=77,
)


def in_chunks(stream, generator, largest=40):
    place = 0
    while place < len(stream):
        size = int(generator.integers(1, largest))
        yield stream[place : place + size]
        place += size


def decode_all(decoder, stream, generator=None):
    if generator is None:
        return decoder.decode(stream)
    return [event for chunk in in_chunks(stream, generator) for event in decoder.decode(chunk)]


def reporting_board(name):
    board = BOARDS[name]()
    board.boot(ATMOSPHERE)
    board.decode(host_protocol(Settings(protocol=name)).start())
    return board


def report(board, asker, reading=READING):
    """Return what a board says at one tick: a report, or the answers to what it is asked."""
    said = board.telemetry(reading)
    data = b"" if said else asker.vent()
    while data:
        answer = b"".join(board.reply(command, reading) for command in board.decode(data))
        asker.decode(answer)
        said, data = said + answer, asker.follow_up()
    return said


# ------------------------------------------------------------------------------ exact bytes


def test_ezloop_bytes():
    host = host_protocol(Settings(protocol="ezloop"))
    assert host.setpoint([7500.0, 0.0, 0.0, 20.0]) == (b"<1088.25,1013.25,1013.25,1013.45>\n")
    assert host.vent() == b"<1013.25,1013.25,1013.25,1013.25>\n"
    assert BOARDS["ezloop"]().telemetry(READING) == (
        b"[MPR]: 1019.00 1093.22 1018.50 1018.40\r\n"
        b"[RPR]: 1400.20\r\n[VAL]: 0.00 0.25 1.00 0.50\r\n"
    )


def test_ctrlp_bytes():
    host = host_protocol(Settings(protocol="ctrlp"))
    assert host.setpoint([7500.0, 0.0, 0.0, 20.0]) == (b"SET;0.050;7.500;0.000;0.000;0.020\n")
    assert host.vent() == b"SET;0.000;0.000;0.000;0.000;0.000\n"
    assert reporting_board("ctrlp").telemetry(READING) == (
        b"12345\t0\t0.00\t0.00\t0.00\t0.00\r\n12345\t1\t0.09\t7.51\t0.04\t0.03\r\n"
    )


def test_a_pair_near_the_boards_limit_is_sent_lower_with_the_same_difference():
    board = BOARDS["ezloop"]()
    for difference in (24_000.0, -24_000.0, 30_000.0):
        host = host_protocol(Settings(protocol="ezloop"))
        host.room = lambda: 102_900.0
        data = host.setpoint(chamber_gauge([difference, 0.0]))
        (command,) = board.decode(data)
        assert max(command.pressure) <= 125_000.0
        assert command.pressure[0] - command.pressure[1] == pytest.approx(difference, abs=1.0)


def test_the_ezloop_board_ignores_a_command_above_its_limit_whole():
    board = BOARDS["ezloop"]()
    assert board.decode(b"<1013.00,1250.01,1013.00,1013.00>\n") == []
    assert board.rejected == 1
    assert len(board.decode(b"<1013.00,1250.00,1013.00,1013.00>\n")) == 1


# --------------------------------------------------------------------------- both directions


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("split", [False, True])
def test_commands_arrive_as_they_were_meant(name, split):
    generator = np.random.default_rng(3) if split else None
    host, board = host_protocol(Settings(protocol=name)), BOARDS[name]()
    wanted = np.random.default_rng(4).uniform(-24_000.0, 24_000.0, (60, 2))
    stream = host.start() + b"".join(host.setpoint(chamber_gauge(u)) for u in wanted)
    commands = [c for c in decode_all(board, stream, generator) if c.kind == "setpoint"]
    assert len(commands) == len(wanted)
    for command, difference in zip(commands, wanted, strict=True):
        pressure = np.array(command.pressure)
        step = max(1.1, host.resolution)
        assert pressure[0::2] - pressure[1::2] == pytest.approx(difference, abs=step)
        assert command.valid_for in (None, 0.25, BUS_PATIENCE)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("split", [False, True])
def test_telemetry_arrives_as_it_was_measured(name, split):
    generator = np.random.default_rng(5) if split else None
    host, board = host_protocol(Settings(protocol=name)), reporting_board(name)
    host.assumed_atmosphere = ATMOSPHERE
    garbage = b"\x00noise\xff" + (b"\0" if name == "native" else b"\n")
    events = decode_all(
        host, garbage + report(board, host_protocol(Settings(protocol=name))), generator
    )
    merged = {}
    for event in events:
        if isinstance(event, Telemetry):
            merged.update({k: v for k, v in vars(event).items() if v is not None})
    # Two decimals of a kPa, or half a step.
    step = 5.1 if name == "ctrlp" else max(1.1, 0.51 * host.resolution)
    assert merged["chamber_pressure"] == pytest.approx(READING.chamber_pressure, abs=step)
    assert host.rejected >= 1
    if host.reports_supply:
        assert merged["supply_pressure"] == pytest.approx(READING.supply_pressure, abs=1.0)
        assert merged["valve_opening"] == pytest.approx(READING.valve_opening, abs=0.005)


def test_a_native_board_refuses_more_than_it_reaches():
    host, board = host_protocol(Settings(protocol="native")), NativeBoard(4, 30_000)
    (command,) = board.decode(host.setpoint([31_000.0, 0.0, 0.0, 0.0]))
    assert command.kind == "refused"
    (report,) = host.decode(board.reply(command, READING))
    assert report == BoardText("refused: pressure out of range")


@pytest.mark.parametrize(
    "body",
    [b"", b"\x00\x00" + bytes(16), b"\xfa\x00" + bytes(12), b"\xfa\x00" + b"\xff" * 16],
    ids=["empty", "valid for nothing", "three chambers", "negative"],
)
def test_native_board_refuses_malformed_setpoints(body):
    (command,) = BOARDS["native"]().decode(encode(FrameType.SETPOINT, 5, body))
    assert command.kind == "refused"
    assert command.sequence == 5


def test_frames_of_another_version_or_type_are_rejected():
    host = host_protocol(Settings(protocol="native"))
    assert host.decode(seal(bytes([2, FrameType.STATUS, 0, 0]))) == []
    assert host.decode(seal(bytes([1, 0x44, 0, 0]))) == []
    assert host.rejected == 2


def test_the_checksum_is_that_of_the_catalogues():
    assert crc16(b"123456789") == 0x29B1


# ---------------------------------------------------------------------------------- fuzzing

MILLION = 1_000_000


def random_bytes(seed):
    """Half of it plain random, half drawn from the protocols' own alphabet."""
    generator = np.random.default_rng(seed)
    plain = generator.integers(0, 256, MILLION // 2, dtype=np.uint8)
    alphabet = np.frombuffer(b"[MPRVAL]: 0123456789.-\t\r\n<>,;_SETON\0\x01\x02", dtype=np.uint8)
    return plain.tobytes() + generator.choice(alphabet, MILLION // 2).tobytes()


def mutated(sound, seed):
    """Bit flips, lost and doubled bytes in a stream of a million sound bytes."""
    generator = np.random.default_rng(seed)
    stream = np.frombuffer(sound * (MILLION // len(sound) + 1), dtype=np.uint8)[:MILLION].copy()
    hit = generator.random(len(stream)) < 0.01
    stream[hit] ^= (1 << generator.integers(0, 8, hit.sum())).astype(np.uint8)
    copies = np.ones(len(stream), dtype=int)
    copies[generator.random(len(stream)) < 0.002] = 0
    copies[generator.random(len(stream)) < 0.002] = 2
    return np.repeat(stream, copies).tobytes()


def board_stream(name):
    """What a board says in a while, with changing numbers."""
    board, asker = reporting_board(name), host_protocol(Settings(protocol=name))
    generator = np.random.default_rng(6)
    stream = b""
    for step in range(200):
        pressure = ATMOSPHERE + generator.uniform(-100.0, 24_000.0, 4)
        reading = BoardReading(
            step * 0.05, tuple(pressure), ATMOSPHERE, (0.0, 0.1, 0.2, 1.0), 1.4e5
        )
        stream += report(board, asker, reading)
    return stream


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["random", "mutated"])
def test_a_million_bytes_into_the_hosts_decoder(name, kind):
    sound = board_stream(name)
    stream = random_bytes(8) if kind == "random" else mutated(sound, 9)
    host = host_protocol(Settings(protocol=name))
    events = decode_all(host, stream, np.random.default_rng(10))
    pressures = [
        e.chamber_pressure for e in events if isinstance(e, Telemetry) and e.chamber_pressure
    ]
    if name == "native":
        truth = {
            e.chamber_pressure
            for e in host_protocol(Settings(protocol=name)).decode(sound)
            if isinstance(e, Telemetry)
        }
        assert set(pressures) <= truth
        assert not [e for e in events if isinstance(e, BoardText | BoardIdentity | BoardFailure)]
    assert host.rejected > 1000
    assert (len(pressures) > 1000) == (kind == "mutated")
    # After all that, a sound report is read at once.
    end = decode_all(host, b"\n\0" + board_stream(name)[: len(sound) // 10])
    assert any(isinstance(e, Telemetry) and e.chamber_pressure for e in end)


@pytest.mark.parametrize(
    ("protocol", "wiring"),
    [("ezloop", "3,4,2,1"), ("native", "1,3,2,4"), ("festo", "4 1 3 2"), ("pneudrive", "2,3,4,1")],
)
def test_a_command_fills_the_valves_that_feed_the_chambers(simulate, protocol, wiring):
    sim = simulate(protocol, wiring=wiring)
    sim.track()
    valves = [int(word) - 1 for word in wiring.replace(",", " ").split()]
    filled = [sim.gauge[valve] > 2_000.0 for valve in valves]
    assert filled == [True, False, False, True]
    assert [value > 2_000.0 for value in sim.core.monitor.gauge] == filled


@pytest.mark.parametrize(
    ("protocol", "wiring", "said"),
    [
        ("native", "1,2,3", "name each of 1, 2, 3, 4 once"),
        ("native", "1,1,2,3", "name each of 1, 2, 3, 4 once"),
        ("ezloop", "1,3,2,4", "hoses of each segment on one pair"),
    ],
)
def test_wirings_that_no_board_can_play_are_refused_with_the_remedy(protocol, wiring, said):
    with pytest.raises(SettingError, match=said):
        Settings(protocol=protocol, wiring=wiring)
