"""The streamer on a clock that the test moves: what is sent when, and how plans end."""

import dataclasses
import threading

import numpy as np
import pytest

from der_planner.limb import Limb
from der_planner.planning import Motion, plan
from der_planner.planning.streaming import GRID, Ending, Schedule, Streamer, first_stamp

LEAD = 4 * GRID


class Stage:
    """A streamer, what it has sent, and how its plans ended."""

    def __init__(self):
        self.now, self.items, self.ended, self.obstacle = 1_000_000_007, [], [], None
        self.changed = threading.Condition()
        self.streamer = Streamer(lambda: self.now, self.send, self.end, lambda: self.obstacle, LEAD)

    def send(self, schedule, index):
        with self.changed:
            self.items.append((schedule, index))
            self.changed.notify_all()

    def end(self, schedule, outcome, reason):
        with self.changed:
            self.ended.append((schedule.plan_id, outcome))
            self.changed.notify_all()

    def wait(self, condition):
        with self.changed:
            assert self.changed.wait_for(condition, timeout=30.0)

    def move_to(self, instant):
        with self.streamer.lock:
            self.now = instant
            self.streamer.lock.notify_all()

    def send_until(self, schedule, index):
        """Move the clock to the instant at which a setpoint is sent."""
        self.move_to(schedule.stamp(index) - LEAD)
        self.wait(lambda: (schedule, index) in self.items)


@pytest.fixture(scope="module")
def short():
    motion = Motion.named("asynchronous", amplitude=0.4, period=4.0, cycles=1)
    return plan(Limb.default(), motion, "der", "projected")


@pytest.fixture
def stage():
    stage = Stage()
    yield stage
    stage.streamer.close()


def test_first_stamp_is_on_the_grid_and_leaves_time():
    for now in (1, GRID, 7 * GRID - 1, 123456789012):
        stamp = first_stamp(now, LEAD)
        assert stamp % GRID == 0
        assert LEAD <= stamp - now < LEAD + GRID
    assert first_stamp(0, LEAD, wanted=100 * GRID + 1) == 101 * GRID
    assert first_stamp(1000 * GRID, LEAD, wanted=100 * GRID) == 1004 * GRID


def test_every_setpoint_is_sent_once_in_order_and_not_early(stage, short):
    schedule = stage.streamer.play("a", short, 0)
    assert schedule.start % GRID == 0
    stage.send_until(schedule, 30)
    assert [index for _, index in stage.items] == list(range(31))
    stage.send_until(schedule, schedule.count - 1)
    assert [index for _, index in stage.items] == list(range(schedule.count))
    stage.streamer.end_what_is_over()
    assert not stage.ended
    stage.now = schedule.stamp(schedule.count - 1)
    stage.streamer.end_what_is_over()
    assert stage.ended == [("a", "finished")]


def test_a_plan_that_begins_in_motion_takes_over_at_its_first_stamp(stage, short):
    first = stage.streamer.play("a", short, 0)
    stage.send_until(first, 20)
    moving = dataclasses.replace(short.reference, start=first.leave(first.stamp(40)))
    following = dataclasses.replace(short, reference=moving)
    second = stage.streamer.play("b", following, first.stamp(40))
    stage.send_until(second, second.count - 1)
    stamps = [schedule.stamp(index) for schedule, index in stage.items]
    assert np.all(np.diff(stamps) == GRID)
    assert [s.plan_id for s, _ in stage.items] == ["a"] * 40 + ["b"] * second.count
    assert stage.ended == [("a", "replaced")]


def test_a_plan_that_begins_at_rest_waits_for_the_end_of_what_is_played(stage, short):
    first, second = (stage.streamer.play(name, short, 0) for name in "ab")
    assert second.start == first.stamp(first.count)
    stage.send_until(second, 0)
    assert stage.items[-2:] == [(first, first.count - 1), (second, 0)]


def test_stop_sends_nothing_more(stage, short):
    first = stage.streamer.play("a", short, 0)
    stage.send_until(first, 5)
    assert stage.streamer.stop("stopped", "")
    second = stage.streamer.play("b", short, 0)
    stage.send_until(second, second.count - 1)
    assert [s.plan_id for s, _ in stage.items] == ["a"] * 6 + ["b"] * second.count
    assert stage.ended == [("a", "stopped")]
    assert not stage.streamer.stop("stopped", "")


def test_a_driver_that_takes_nothing_ends_every_plan_and_spends_their_ids(stage, short):
    first = stage.streamer.play("a", short, 0)
    stage.streamer.play("a-2", short, 0)
    stage.send_until(first, 0)
    stage.obstacle = Ending("fault", "low supply")
    stage.move_to(first.stamp(1))
    stage.wait(lambda: len(stage.ended) == 2)
    assert stage.ended == [("a", "fault"), ("a-2", "fault")]
    assert stage.streamer.is_spent("a")
    assert stage.streamer.unspent("a") == "a-3"


def test_leaving_a_schedule_gives_the_state_there(short):
    schedule = Schedule("a", short, 20 * GRID)
    assert schedule.leave(20 * GRID) is None
    assert schedule.leave(schedule.stamp(schedule.count)) is None
    start = schedule.leave(50 * GRID)
    angles, rate, _ = short.reference.sample(30 * 0.05)
    np.testing.assert_allclose(start.bend_angles, angles)
    np.testing.assert_allclose(start.rate, rate)
    np.testing.assert_array_equal(start.pressure, short.differential_pressure[29])
