"""Learning from run to run, on a rod that is not the one of the plan."""

from dataclasses import replace

import numpy as np
import pytest

from der_planner.control import Learner, LearningError
from der_planner.limb import Limb
from der_planner.model.response import simulate
from der_planner.planning import CONTROL_PERIOD, Motion, plan

LIMB = Limb.default()


def other_limb(gain=0.9, rest=0.035):
    segments = tuple(
        replace(s, moment_gain=s.moment_gain * gain, rest_curvature=rest / s.length)
        for s in LIMB.segments
    )
    return replace(LIMB, segments=segments)


def play(planned, limb):
    """Return the tip (K, 2) [m] of another limb under the plan's commands."""
    return simulate(limb, planned.time, commands=planned.differential_pressure).tip[:-1]


def mean_error(planned, tip):
    return np.linalg.norm(tip - planned.tip_reference, axis=1).mean()


@pytest.fixture(scope="module")
def first():
    return plan(LIMB, Motion.named("same_direction", period=20.0, cycles=1), method="optimal")


def learn(first, limb, runs):
    learner, planned, errors = Learner(first), first, []
    for _ in range(runs):
        tip = play(planned, limb)
        errors.append(mean_error(planned, tip))
        learner.add(planned.time, tip)
        planned = learner.next()
        command = planned.differential_pressure
        air = LIMB.pneumatics
        steps = np.diff(command, axis=0, prepend=np.zeros((1, 2)))
        assert np.abs(command).max() <= air.pressure_limit
        assert np.abs(steps).max() <= air.slew_limit * CONTROL_PERIOD * (1 + 1e-12)
    return learner, planned, errors


def test_the_error_falls_by_more_than_three_in_two_runs_within_all_limits(first):
    learner, _, errors = learn(first, other_limb(), 3)
    assert errors[2] < errors[0] / 3
    assert [run.mean_error for run in learner.history] == pytest.approx(errors, rel=1e-6)
    assert all(run.accepted for run in learner.history)


def test_the_same_runs_give_the_same_plan(first):
    one, two = (learn(first, other_limb(), 2)[1] for _ in range(2))
    assert np.array_equal(one.differential_pressure, two.differential_pressure)


def test_lost_tags_teach_nothing_where_they_were_lost(first):
    limb = other_limb()
    tip = play(first, limb)
    lost = (first.time > 8.0) & (first.time < 11.0)
    learner = Learner(first)
    learner.add(first.time, np.where(lost[:, None], np.nan, tip))
    after = learner.next()
    before = np.linalg.norm(tip - first.tip_reference, axis=1)
    left = np.linalg.norm(play(after, limb) - first.tip_reference, axis=1)
    assert left[~lost].mean() < before[~lost].mean() / 2
    assert left[lost].max() < 2 * before[lost].max()
    assert learner.history[0].seen == pytest.approx(1 - lost.mean(), abs=0.02)


def test_an_unseen_a_vented_and_a_swapped_limb_are_refused(first):
    learner, planned, _ = learn(first, other_limb(), 2)
    tip = play(planned, other_limb())
    unseen = np.where((planned.time > 5.0)[:, None], np.nan, tip)
    for given, reason in (
        (unseen, "seen at"),
        (np.tile(tip[0], (len(tip), 1)), "does not follow"),
        (play(planned, other_limb(gain=0.4)), "cm is"),
    ):
        learner.add(planned.time, given)
        assert not learner.history[-1].accepted
        assert reason in learner.history[-1].reason
        assert learner.next() is planned


def test_a_worse_run_goes_back_to_the_best_with_a_smaller_step(first):
    learner, planned, errors = learn(first, other_limb(), 2)
    bent = play(planned, other_limb()) + np.array([0.0, 2 * errors[0]])
    learner.add(planned.time, bent)
    assert learner.history[-1].step == 0.5
    assert "back to it" in learner.history[-1].reason
    tip = play(learner.next(), other_limb())
    assert mean_error(first, tip) <= errors[1]


def test_learning_stops_when_repeats_differ_as_much_as_is_left(first):
    learner, planned, _ = learn(first, other_limb(), 3)
    rng = np.random.default_rng(3)
    tip = play(planned, other_limb())
    for _ in range(3):
        learner.add(planned.time, tip + rng.normal(scale=2e-3, size=tip.shape))
    assert "only noise is left" in learner.stopped
    assert learner.stopped in learner.history[-1].reason


def test_an_uncertain_measurement_counts_for_less(first):
    doubtful = np.tile(np.eye(2) * 1e-2**2, (len(first.time), 1, 1))
    changes = []
    for covariance in (None, doubtful):
        learner, planned, _ = learn(first, other_limb(), 1)
        learner.add(planned.time, play(planned, other_limb()), covariance)
        change = learner.next().differential_pressure - planned.differential_pressure
        changes.append(np.abs(change).mean())
    assert changes[1] < changes[0] / 2


def test_arcs_are_refused_with_the_remedy():
    arcs = plan(LIMB, Motion.named("same_direction", period=6.0, cycles=1), model="pcc")
    with pytest.raises(LearningError, match="with the model der"):
        Learner(arcs)
