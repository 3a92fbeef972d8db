"""A lab's own driver of valves as a board: numbers and order of its topics, and what is watched."""

import math

import pytest

from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.protocols import (
    BoardFailure,
    BoardIdentity,
    Echo,
    SettingError,
    Telemetry,
    host_protocol,
)
from pressure_driver.settings import Settings, TopicBoardSettings
from pressure_driver.topic_board import STALE, WatchedBoard, from_topic, to_topic

ROOM = 101_325.0
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


def test_setpoints_are_passed_on_and_readings_come_back():
    bench = Bench()
    (identity,) = bench.say(bench.host.start(), 0.0)
    assert isinstance(identity, BoardIdentity)
    data = bench.host.setpoint([7_000.0, 0.0, 0.0, 3_000.0])
    assert bench.say(data, 1.0) == [], "nothing has been measured"
    assert bench.told == [READING]
    telemetry, echo = bench.host.decode(bench.board.measured(READING, 1.1))
    assert telemetry == Telemetry(chamber_pressure=tuple(ROOM + value for value in READING))
    assert echo == Echo(bench.host.number)


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
