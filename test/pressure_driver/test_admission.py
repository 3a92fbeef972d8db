"""Whose setpoints are taken, and in which arming; what goes out is limited at every tick."""

import itertools

import numpy as np
import pytest

from pressure_driver.safety import Mode
from pressure_driver.schedule import (
    RELEASE_TIME,
    Origin,
    Setpoint,
    Verdict,
)

TICK = 50_000_000


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
    stamp = sim.wall + 4 * TICK
    sim.run(0.2)
    assert sim.core.machine.schedule.current.differential == (3_000.0, 0.0)
    late = Setpoint(stamp, (6_000.0, 0.0), "plan of arming 1", 5, 3)
    assert sim.core.offer(late, sim.wall) is Verdict.LATE
    counters = sim.core.machine.schedule.counts
    assert (counters["accepted"], counters["executed"], counters["superseded"]) == (2, 1, 1)
