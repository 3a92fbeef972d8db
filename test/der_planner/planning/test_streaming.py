"""The player on a clock that the test moves."""

import threading
import time as wall

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.planning import Motion, plan
from der_planner.planning.streaming import GRID, Player, Schedule, first_stamp

LEAD = 4 * GRID


class Clock:
    """Runs a hundred times faster than the wall, so that nothing waits."""

    def __init__(self):
        self._begin = wall.monotonic_ns()

    def __call__(self):
        return 1_000_000_007 + 100 * (wall.monotonic_ns() - self._begin)


class Sent:
    def __init__(self, clock):
        self.clock, self.items = clock, []
        self.changed = threading.Condition()

    def send(self, schedule, index):
        with self.changed:
            self.items.append((schedule, index, self.clock()))
            self.changed.notify_all()

    @property
    def over(self):
        return [schedule for schedule, index, _ in self.items if index == schedule.count - 1]

    def wait(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, timeout=30.0)


@pytest.fixture(scope="module")
def short():
    motion = Motion.named("asynchronous", amplitude=0.4, period=4.0, cycles=1)
    return plan(Limb.default(), motion, "der", "projected")


@pytest.fixture
def stage():
    clock = Clock()
    sent = Sent(clock)
    player = Player(clock, sent.send, LEAD)
    yield clock, sent, player
    player.close()


def test_first_stamp_is_on_the_grid_and_leaves_time():
    for now in (1, GRID, 7 * GRID - 1, 123456789012):
        stamp = first_stamp(now, LEAD)
        assert stamp % GRID == 0
        assert LEAD <= stamp - now < LEAD + GRID
    assert first_stamp(0, LEAD, wanted=100 * GRID + 1) == 101 * GRID
    assert first_stamp(1000 * GRID, LEAD, wanted=100 * GRID) == 1004 * GRID


def test_every_setpoint_is_sent_once_in_order_and_not_early(stage, short):
    clock, sent, player = stage
    schedule = Schedule("a", short, first_stamp(clock(), LEAD))
    player.play(schedule)
    sent.wait(lambda: sent.over)
    assert [index for _, index, _ in sent.items] == list(range(len(short.time)))
    for _, index, now in sent.items:
        assert now >= schedule.stamp(index) - LEAD
        assert schedule.stamp(index) % GRID == 0
    assert player.position is None


def test_a_waiting_schedule_takes_over_at_its_first_stamp(stage, short):
    clock, sent, player = stage
    first = Schedule("a", short, first_stamp(clock(), LEAD))
    player.play(first)
    second = Schedule("b", short, first.stamp(40))
    player.play(second)
    sent.wait(lambda: sent.over)
    assert sent.over == [second]
    stamps = [schedule.stamp(index) for schedule, index, _ in sent.items]
    assert np.all(np.diff(stamps) == GRID)
    assert [s.plan_id for s, _, _ in sent.items] == ["a"] * 40 + ["b"] * len(short.time)


def test_stop_sends_nothing_more(stage, short):
    clock, sent, player = stage
    player.play(Schedule("a", short, first_stamp(clock(), LEAD)))
    sent.wait(lambda: len(sent.items) > 5)
    assert player.stop()
    count = len(sent.items)
    player.play(Schedule("b", short, first_stamp(clock(), LEAD)))
    sent.wait(lambda: sent.over)
    late = sent.items[count:]
    assert sum(s.plan_id == "a" for s, _, _ in late) <= 1
    assert not Player.stop(player)


def test_leaving_a_schedule_gives_the_state_there(short):
    schedule = Schedule("a", short, 20 * GRID)
    assert schedule.leave(20 * GRID) is None
    assert schedule.leave(schedule.stamp(schedule.count)) is None
    start = schedule.leave(50 * GRID)
    angles, rate, _ = short.reference.sample(30 * 0.05)
    np.testing.assert_allclose(start.bend_angles, angles)
    np.testing.assert_allclose(start.rate, rate)
    np.testing.assert_array_equal(start.pressure, short.differential_pressure[29])
