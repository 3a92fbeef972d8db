"""Boards of our own making: the emulated one, its air and port, and a lab's driver as a board."""

import math
import os

import numpy as np
import pytest

from pressure_driver.emulator.board import EmulatedBoard, FaultError, Faults
from pressure_driver.emulator.firmware import BOARDS, NativeBoard
from pressure_driver.emulator.line import EmulatedPort
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.protocols import (
    BoardFailure,
    SettingError,
    host_protocol,
)
from pressure_driver.settings import Settings, TopicBoardSettings
from pressure_driver.topic_board import STALE, WatchedBoard, from_topic, to_topic

SEEDS = range(8)


def trace(air, command, seconds, dt=0.01):
    air.command(air.atmosphere + np.asarray(command))
    return np.array([air.step(dt) - air.atmosphere for _ in range(round(seconds / dt))])


@pytest.mark.parametrize("seed", SEEDS)
def test_filling_is_a_ramp_and_lifts_the_neighbour_for_a_second(seed):
    air = BoardPneumatics(2, seed)
    gauge = trace(air, [7000.0, 0.0, 0.0, 0.0], 5.0)
    rate = np.diff(gauge[:, 0]) / 0.01
    middle = (gauge[1:, 0] > 700.0) & (gauge[1:, 0] < 5000.0)
    assert 8000.0 < rate[middle].mean() < 10_000.0
    assert gauge[-1, 0] == pytest.approx(7000.0, abs=15.0)
    assert 0.12 < gauge[:, 1].max() / 7000.0 < 0.26
    lifted = gauge[:, 1] > 0.05 * 7000.0
    assert 0.8 < lifted.sum() * 0.01 < 2.0
    assert np.all(np.abs(gauge[:, 2:]) < 1e-9)


def test_a_chamber_lifts_its_neighbour_in_the_limb_whatever_the_hoses():
    gauge = trace(BoardPneumatics(2, 1, [3, 0, 2, 1]), [0.0, 7000.0, 0.0, 0.0], 1.0)[-1]
    assert gauge[3] > 800.0
    assert np.all(np.abs(gauge[[0, 2]]) < 1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_venting_takes_its_time_and_ends(seed):
    air = BoardPneumatics(2, seed)
    trace(air, [0.0, 0.0, 7000.0, 0.0], 4.0)
    gauge = trace(air, [0.0] * 4, 8.0)[:, 2] / 7000.0
    duration = 0.01 * (np.argmax(gauge < 0.1) - np.argmax(gauge < 0.9))
    assert duration == pytest.approx(2.5, rel=0.15)
    assert abs(gauge[-1]) < 0.005
    assert np.all(np.diff(gauge[gauge > 0.02]) <= 1e-9)


def test_seeds_repeat_and_differ():
    runs = [trace(BoardPneumatics(2, seed), [9000.0, 0.0, 0.0, 5000.0], 1.0) for seed in (3, 3, 4)]
    assert np.array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 50.0
    assert BoardPneumatics(2, 3).atmosphere != BoardPneumatics(2, 4).atmosphere


def test_the_step_size_does_not_matter():
    ends = []
    for count in (1, 20, 150):
        air = BoardPneumatics(2, 1)
        air.command(air.atmosphere + np.array([9000.0, 0.0, 0.0, 4000.0]))
        for _ in range(count):
            air.step(0.6 / count)
        ends.append(air.pressure)
    assert ends[0] == pytest.approx(ends[1], abs=40.0)
    assert ends[1] == pytest.approx(ends[2], abs=40.0)


# ------------------------------------------------------------------------------------ board


@pytest.mark.parametrize(
    "text", ["jam", "stick", "stick:4", "stick:0.5", "stick:-1", "drop:1.5", "mute:1", "leak:a"]
)
def test_fault_texts_that_are_not_understood(text):
    with pytest.raises(FaultError, match="fault"):
        Faults.parse([text], 4)


def test_fault_texts():
    faults = Faults.parse(
        ["drop:0.1", " stick:1", "leak:2", "leak:0:5", "mute", "supply:1e5", "unplug:2"], 4
    )
    assert (faults.drop, faults.stick, faults.leak) == (0.1, [1], {2: 3.0, 0: 5.0})
    assert faults.mute
    assert (faults.supply, faults.unplug) == (1e5, 2.0)
    assert Faults.parse([""], 4) == Faults()


def test_dropped_and_corrupted_bytes_come_in_the_stated_share():
    board = EmulatedBoard(BOARDS["ezloop"](), BoardPneumatics(2), 0)
    board.set_faults(Faults.parse(["drop:0.3"], 4))
    data = host_protocol(Settings(protocol="ezloop")).vent()
    got = sum(len(board.receive(data)[0]) for _ in range(2000))
    assert got / 2000 == pytest.approx(0.7, abs=0.04)
    faults = Faults.parse(["corrupt:0.05"], 4)
    clean = bytes(20_000)
    damaged = np.frombuffer(faults.damage(clean, np.random.default_rng(1)), dtype=np.uint8)
    assert np.mean(damaged != 0) == pytest.approx(0.05, abs=0.01)
    assert np.all(np.bitwise_count(damaged) <= 1)


# ------------------------------------------------------------------------------------- port


def test_the_port_overwrites_no_file_and_takes_no_link_from_another_emulator(tmp_path):
    (tmp_path / "file").write_text("precious")
    with pytest.raises(FileExistsError, match="port_link"):
        EmulatedPort(str(tmp_path / "file"))
    assert (tmp_path / "file").read_text() == "precious"
    first = EmulatedPort(str(tmp_path / "board"))
    device = os.readlink(first.link)
    with pytest.raises(FileExistsError, match="another emulator serves"):
        EmulatedPort(first.link)
    assert os.readlink(first.link) == device
    first.close()
    EmulatedPort(first.link).close()


READING = (7_000.0, 0.0, 0.0, 3_000.0)


class Bench:
    """The driver's end, the board, and what it regulates to."""

    def __init__(self):
        self.told = []
        self.host = host_protocol(Settings(protocol="native"))
        self.board = WatchedBoard(NativeBoard(4, 30_000, known=0), self.told.append)

    def say(self, data, now):
        return self.host.decode(self.board.receive(data, now))


def test_the_topics_have_their_own_unit_and_zero():
    settings = TopicBoardSettings(scale=0.01, offset=1013.25)
    told = to_topic((100.0, 200.0, 300.0, 400.0), settings)
    assert told == pytest.approx([1014.25, 1015.25, 1016.25, 1017.25])
    assert from_topic(told, settings) == pytest.approx([100.0, 200.0, 300.0, 400.0])


@pytest.mark.parametrize("told", [(0.0, 0.0, 0.0), (0.0, 0.0, 0.0, math.nan)])
def test_readings_that_are_not_a_number_for_each_chamber_are_refused(told):
    with pytest.raises(ValueError, match="4 numbers are expected"):
        from_topic(told, TopicBoardSettings())


def test_one_topic_for_the_pressures_of_each_chamber_is_refused():
    with pytest.raises(SettingError, match="'measured_topic'"):
        TopicBoardSettings(message="FluidPressure", command_topic="/valve{}/command")


def test_readings_that_stop_are_not_told_again():
    bench = Bench()
    bench.board.measured(READING, 1.0)
    command = bench.host.vent()
    assert bench.say(command, 1.0 + 0.5 * STALE)
    assert bench.say(command, 1.0 + 1.5 * STALE) == []


def test_it_vents_by_itself_when_setpoints_cease():
    bench = Bench()
    bench.say(bench.host.setpoint([7_000.0, 0.0, 0.0, 3_000.0]), 1.0)
    assert bench.board.look(1.25) == b""
    (failure,) = bench.host.decode(bench.board.look(1.26))
    assert isinstance(failure, BoardFailure)
    assert bench.told == [READING, (0.0,) * 4]
    assert bench.board.look(2.0) == b""
