"""Whose setpoints are taken, in which arming, when they take effect, and within which limits."""

import itertools

import numpy as np
import pytest

from pressure_driver import schedule as schedule_module
from pressure_driver.safety import Mode
from pressure_driver.schedule import (
    RELEASE_TIME,
    Origin,
    Setpoint,
    SetpointSchedule,
    TickGrid,
    Verdict,
)
from pressure_driver.settings import Settings

PERIOD = 50_000_000


# ----------------------------------------------------------------------- a plan and its arming


@pytest.mark.parametrize("end", ["vent", "fault"])
def test_a_plan_that_streams_on_through_a_vent_is_refused_after_the_next_arming(simulate, end):
    sim = simulate()
    sim.arm()
    sim.stream(1.0, lambda t: (4_000.0 * t, 0.0))
    if end == "vent":
        sim.core.vent()
    else:
        sim.core.lost("pulled")
        sim.tick()
        sim.core.opening()
    rest = iter(range(20, 100_000))
    while not sim.core.arm()[0]:
        assert sim.offer((9_000.0, 0.0), plan_id="plan of arming 1", index=next(rest)) is (
            Verdict.REFUSED
        )
        sim.tick()
    for _ in range(40):
        verdict = sim.offer((9_000.0, 0.0), plan_id="plan of arming 1", index=next(rest))
        assert verdict is Verdict.REFUSED
        assert "before the driver was armed" in sim.core.machine.schedule.reason
        sim.tick()
        assert sim.is_vent(sim.sent[-1])
    assert sim.offer((1_000.0, 0.0), plan_id="new") is Verdict.ACCEPTED


def test_setpoints_without_a_plan_must_pause_after_a_vent(simulate):
    sim = simulate()
    sim.arm()

    def typed():
        return sim.core.offer(Setpoint(0, (3_000.0, 0.0)), sim.wall)

    for _ in range(10):
        assert typed() is Verdict.ACCEPTED
        sim.tick()
    sim.core.vent()
    while not sim.core.arm()[0]:
        assert typed() is Verdict.REFUSED
        sim.tick()
    for _ in range(60):
        assert typed() is Verdict.REFUSED
        assert "stop them" in sim.core.machine.schedule.reason
        sim.tick()
    sim.run(RELEASE_TIME + 0.05)
    assert typed() is Verdict.ACCEPTED


# ------------------------------------------------------------------------- one publisher at a time


class Publisher:
    """Counts its messages as the middleware does."""

    def __init__(self, sim, value, first=1, alone=False, topic="/limb/pressure_setpoint"):
        self.sim, self.value = sim, value
        self.alone, self.topic = alone, topic
        self.numbers = itertools.count(first)

    def publish(self, plan_id=""):
        origin = Origin(self.topic, next(self.numbers), self.alone)
        item = Setpoint(0, (self.value, 0.0), plan_id)
        return self.sim.core.offer(item, self.sim.wall, origin)


@pytest.mark.parametrize("plan_id", ["", "same"])
@pytest.mark.parametrize("first", [1, 9, 500])
def test_a_second_publisher_is_refused_whatever_its_plan_is_called(simulate, plan_id, first):
    sim = simulate()
    sim.arm()
    one, other = Publisher(sim, 4_000.0, 7), Publisher(sim, -4_000.0, first)
    for _ in range(40):
        assert one.publish(plan_id) is Verdict.ACCEPTED
        assert other.publish(plan_id) is Verdict.REFUSED
        assert "another publisher" in sim.core.machine.schedule.reason
        sim.tick()
        assert sim.core.state()["commanded_differential"][0] >= 0.0
    assert sim.core.machine.publishers.refused == 40
    # The first one ends: the second is refused until the driver is armed again.
    for _ in range(80):
        assert other.publish(plan_id) is Verdict.REFUSED
        sim.tick()
    assert sim.mode is Mode.ARMED
    assert sim.core.arm()[0]
    assert other.publish(plan_id) is Verdict.ACCEPTED


def test_two_publishers_that_count_in_step_are_both_refused(simulate):
    sim = simulate()
    sim.arm()
    one, other = Publisher(sim, 4_000.0), Publisher(sim, -4_000.0)
    verdicts = []
    for index in range(60):
        # Which of the two is first changes from tick to tick.
        for publisher in (one, other) if index % 2 else (other, one):
            verdicts.append(publisher.publish())
        sim.tick()
    assert verdicts[4:].count(Verdict.ACCEPTED) == 0
    assert "two publishers" in sim.core.machine.schedule.reason
    assert sim.mode is not Mode.TRACKING
    sim.run(3.0)
    assert one.publish() is Verdict.REFUSED
    assert sim.core.arm()[0]
    assert one.publish() is Verdict.ACCEPTED


def test_a_lone_publisher_may_lose_messages_but_one_that_starts_anew_is_another(simulate):
    sim = simulate()
    sim.arm()
    for number in (1, 2, 3, 7, 9):
        publisher = Publisher(sim, 1_000.0, number, alone=True)
        assert publisher.publish() is Verdict.ACCEPTED
        sim.tick()
    assert Publisher(sim, 1_000.0, 1, alone=True).publish() is Verdict.REFUSED


def test_another_topic_is_another_publisher(simulate):
    sim = simulate()
    sim.arm()
    one = Publisher(sim, 1_000.0, alone=True)
    other = Publisher(sim, 2_000.0, 2, alone=True, topic="cmd_u_t")
    assert one.publish() is Verdict.ACCEPTED
    assert other.publish() is Verdict.REFUSED


# ----------------------------------------------------------------- the output moves by its limit


@pytest.mark.slow
def test_random_setpoints_never_step_the_output(simulate):
    generator = np.random.default_rng(5)
    sim = simulate(slew_limit=60_000.0)
    sim.arm()
    commanded = []
    for index in range(800):
        if generator.random() < 0.15:
            ahead = 0.05 * generator.integers(1, 60)
            value = generator.uniform(-24e3, 24e3, 2)
            plan = f"plan {generator.integers(0, 40)}"
            sim.offer(value, ahead, plan, index)
        sim.tick()
        commanded.append(sim.core.machine.differential)
        if sim.mode is Mode.FAULT:
            break
    live = np.array(commanded)
    falls = np.abs(live[1:]) < np.abs(live[:-1])
    moves = np.abs(np.diff(live, axis=0))
    assert moves[~falls].max() <= 3_000.0 * (1.0 + 1e-6)


# ------------------------------------------------------------------------- revisions and gaps


def test_a_higher_revision_that_comes_in_time_replaces_the_earlier_one(simulate):
    sim = simulate()
    sim.arm()
    assert sim.offer((1_000.0, 0.0), index=5) is Verdict.ACCEPTED
    assert sim.offer((2_000.0, 0.0), index=5) is Verdict.DUPLICATE
    assert sim.offer((3_000.0, 0.0), index=5, revision=2) is Verdict.ACCEPTED
    assert sim.offer((4_000.0, 0.0), index=5, revision=1) is Verdict.DUPLICATE
    assert "revision 2" in sim.core.machine.schedule.reason
    assert sim.offer((5_000.0, 0.0), index=6, revision=3) is Verdict.DUPLICATE
    stamp = sim.wall + 4 * PERIOD
    sim.run(0.2)
    assert sim.core.machine.schedule.current.differential == (3_000.0, 0.0)
    late = Setpoint(stamp, (6_000.0, 0.0), "plan of arming 1", 5, 3)
    assert sim.core.offer(late, sim.wall) is Verdict.LATE
    counters = sim.core.machine.schedule.counts
    assert (counters["accepted"], counters["executed"], counters["superseded"]) == (2, 1, 1)


NOW = 1_700_000_000 * 1_000_000_000
ZERO = (0.0, 0.0)


def setpoint(steps, value=1000.0, plan_id="a", index=0, offset=0):
    return Setpoint(NOW + steps * PERIOD + offset, (value, -value), plan_id, index)


def offer(schedule, item, now=NOW):
    return schedule.offer(item, now, ZERO)


def test_a_stamp_between_ticks_takes_effect_at_the_next_one_and_the_later_of_two_stays():
    schedule = SetpointSchedule(Settings())
    offer(schedule, setpoint(2, 1000.0, offset=1))
    offer(schedule, setpoint(3, 2000.0, index=1))
    assert schedule.take(NOW + 2 * PERIOD) is None
    assert schedule.take(NOW + 3 * PERIOD).differential[0] == 2000.0
    assert schedule.counts["superseded"] == 1


def test_stamp_zero_is_the_next_tick():
    schedule = SetpointSchedule(Settings())
    schedule.take(NOW)
    item = Setpoint(0, (500.0, 0.0))
    assert offer(schedule, item, NOW + 10**6) is Verdict.ACCEPTED
    assert schedule.take(NOW + PERIOD).differential == (500.0, 0.0)
    # Even if the next tick has been taken while the message was under way.
    schedule.take(NOW + 2 * PERIOD)
    assert offer(schedule, item, NOW + PERIOD) is Verdict.ACCEPTED
    assert schedule.take(NOW + 3 * PERIOD)


def test_of_two_untimed_commands_within_a_tick_the_newer_one_counts():
    schedule = SetpointSchedule(Settings())
    schedule.take(NOW)
    for value in (500.0, 700.0):
        assert offer(schedule, Setpoint(0, (value, 0.0)), NOW + 10**6) is Verdict.ACCEPTED
    assert schedule.take(NOW + PERIOD).differential == (700.0, 0.0)
    assert schedule.counts["superseded"] == 1


def test_late_ones_are_counted_and_refused():
    schedule = SetpointSchedule(Settings())
    schedule.take(NOW + 4 * PERIOD)
    assert offer(schedule, setpoint(4), NOW + 4 * PERIOD) is Verdict.LATE
    assert offer(schedule, setpoint(3, offset=1), NOW + 4 * PERIOD) is Verdict.LATE
    assert offer(schedule, setpoint(5), NOW + 4 * PERIOD) is Verdict.ACCEPTED
    assert schedule.counts["late"] == 2
    assert "after its stamp" in schedule.reason


def test_a_new_plan_replaces_the_old_from_its_first_stamp_on():
    schedule = SetpointSchedule(Settings())
    for k in range(1, 9):
        offer(schedule, setpoint(k, 100.0 * k, index=k))
    for k in range(5, 8):
        assert offer(schedule, setpoint(k, 500.0 + k, "b", k)) is Verdict.ACCEPTED
    assert schedule.counts["superseded"] == 4
    assert offer(schedule, setpoint(9, 900.0, "a", 9)) is Verdict.REFUSED
    assert "replaced" in schedule.reason
    plans = []
    for k in range(1, 10):
        schedule.take(NOW + k * PERIOD)
        plans.append(schedule.current.plan_id)
    assert plans == ["a"] * 4 + ["b"] * 5


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ((float("nan"), 0.0), "not finite"),
        ((1000.0,), "expected 2"),
        ((1.0, 2.0, 3.0), "expected 2"),
        ((24_000.1, 0.0), "limit is ±24000 Pa"),
        ((0.0, -24_000.1), "limit is ±24000 Pa"),
        ((10_000.1, 0.0), "Pa/s"),
    ],
)
def test_refused_with_the_reason(values, reason):
    schedule = SetpointSchedule(Settings())
    item = Setpoint(NOW + PERIOD, values, "plan-7", 3)
    assert offer(schedule, item) is Verdict.REFUSED
    assert reason in schedule.reason
    assert "setpoint 3 of 'plan-7'" in schedule.reason
    assert schedule.waiting == 0
    assert schedule.take(NOW + PERIOD) is None


def test_too_far_ahead_is_refused():
    schedule = SetpointSchedule(Settings(horizon=1.0))
    assert offer(schedule, setpoint(20)) is Verdict.ACCEPTED
    assert offer(schedule, setpoint(21, index=1)) is Verdict.REFUSED
    assert "1.05 s ahead" in schedule.reason


def test_slew_is_taken_between_neighbours_in_time():
    limits = Settings(slew_limit=10_000.0)
    schedule = SetpointSchedule(limits)
    assert offer(schedule, setpoint(1, 500.0)) is Verdict.ACCEPTED
    assert offer(schedule, setpoint(11, 5500.0)) is Verdict.ACCEPTED
    # Fits behind its predecessor, but the way to the next would be too steep.
    assert offer(schedule, setpoint(6, 2900.0)) is Verdict.REFUSED
    assert offer(schedule, setpoint(6, 3000.0)) is Verdict.ACCEPTED
    assert schedule.take(NOW + PERIOD)
    # What is held counts, not how long it has been held.
    fresh = SetpointSchedule(limits)
    fresh.offer(setpoint(1, 500.0), NOW, ZERO)
    fresh.take(NOW + PERIOD)
    late = setpoint(101, 5000.0)
    assert fresh.offer(late, NOW + 99 * PERIOD, (500.0, -500.0)) is Verdict.REFUSED


def test_the_buffer_is_bounded(monkeypatch):
    monkeypatch.setattr(schedule_module, "CAPACITY", 10)
    schedule = SetpointSchedule(Settings())
    verdicts = [offer(schedule, setpoint(k, 1.0 * k, index=k)) for k in range(1, 13)]
    assert verdicts == [Verdict.ACCEPTED] * 10 + [Verdict.REFUSED] * 2


# ----------------------------------------------------------------------------------- clocks


def test_ticks_fall_on_the_grid_and_never_before_it():
    grid = TickGrid(PERIOD)
    wall = NOW + 12_345_678
    grid.take(wall)
    for _ in range(1000):
        wall += round(grid.delay(wall) * 1e9) + 7_000
        instant = grid.take(wall)
        assert instant is not None
        assert instant % PERIOD == 0
        assert 0 <= wall - instant < 20_000
        assert grid.take(wall) is None
    assert grid.missed == 0


def test_a_late_wake_skips_what_is_over_and_counts_it():
    grid = TickGrid(PERIOD)
    grid.take(NOW)
    assert grid.take(NOW + PERIOD) == NOW + PERIOD
    assert grid.take(NOW + 5 * PERIOD + 10**6) == NOW + 5 * PERIOD
    assert grid.missed == 3


@pytest.mark.parametrize("step", [-3600, -1, 1, 3600])
def test_a_stepped_wall_clock_moves_the_grid_and_does_not_stop_it(step):
    grid = TickGrid(PERIOD)
    grid.take(NOW)
    moved = NOW + step * 1_000_000_000
    for count in range(1, 40):
        assert grid.delay(moved + count * PERIOD - 1) <= PERIOD / 1e9
        assert grid.take(moved + count * PERIOD) == moved + count * PERIOD
