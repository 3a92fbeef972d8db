"""Learning from run to run, on limbs that are not the one of the plan."""

import copy
import re
from dataclasses import replace

import numpy as np
import pytest
from limbs import mean_error, other_limb, play
from link_chain import LinkChain

from der_planner.control import Learner, LearningError
from der_planner.control.disturbance import later
from der_planner.limb import Limb
from der_planner.model import simulate
from der_planner.planning import CONTROL_PERIOD, Motion, plan
from der_planner.planning.correction import Correction

pytestmark = pytest.mark.slow

LIMB = Limb.default()


@pytest.fixture(scope="module")
def first():
    return plan(LIMB, Motion.named("same_direction", period=12.0, cycles=1), method="optimal")


def learn(first, limb, runs, before=None):
    """Learn from runs on a limb, after those that ``before`` has learned from."""
    learner, planned, errors = copy.deepcopy(before) or (Learner(first), first, [])
    for _ in range(runs):
        tip = play(planned, limb)
        errors.append(mean_error(planned, tip))
        learner.add(planned.time, tip)
        planned = learner.next()
        check_limits(planned)
    return learner, planned, errors


def check_limits(planned):
    command, air = planned.differential_pressure, planned.limb.pneumatics
    steps = np.diff(command, axis=0, prepend=np.zeros((1, 2)))
    assert np.abs(command).max() <= air.pressure_limit
    assert np.abs(steps).max() <= air.slew_limit * CONTROL_PERIOD * (1 + 1e-12)


@pytest.fixture(scope="module")
def two_runs(first):
    return learn(first, other_limb(), 2)


@pytest.fixture
def learned_twice(two_runs):
    """Return learner, next plan and errors after two runs, to go on with."""
    return copy.deepcopy(two_runs)


@pytest.fixture(scope="module")
def learned(first, two_runs):
    return learn(first, other_limb(), 1, two_runs)


def test_the_error_of_a_rod_with_less_gain_falls_by_more_than_five(learned):
    learner, _, errors = learned
    assert errors[2] < errors[0] / 5
    assert [run.mean_error for run in learner.history] == pytest.approx(errors, rel=1e-6)
    assert all(run.accepted for run in learner.history)


def test_a_wild_tip_is_left_out_and_the_next_plan_stays_the_same_until_it_was_played(first):
    limb, learner = other_limb(), Learner(first)
    tip = play(first, limb)
    error = mean_error(first, tip)
    tip[len(tip) // 2] = [0.9, 0.0]
    learner.add(first.time, tip)
    following = learner.next()
    assert mean_error(following, play(following, limb)) < 0.5 * error
    assert learner.next() is following


def test_what_is_expected_of_the_next_plan_comes_true(learned):
    _, planned, _ = learned
    tip = play(planned, other_limb())
    gap = np.linalg.norm(tip - planned.tip_predicted, axis=1).mean()
    assert gap < 5e-4


def test_a_chain_of_links_that_was_never_calibrated_is_learned_in_two_runs():
    motion = Motion.named("asynchronous", period=20.0, cycles=1)
    planned, chain = plan(LIMB, motion, method="optimal"), LinkChain(3)
    learner, errors = Learner(planned), []
    for run in range(3):
        filmed = chain.play(planned.time, planned.differential_pressure, run=run)
        still = chain.play(planned.time, planned.differential_pressure, 0.0, noise=0.0)
        errors.append(mean_error(planned, still.tip))
        learner.add(filmed.time, filmed.tip, np.tile(np.eye(2) * 3e-4**2, (len(filmed.time), 1, 1)))
        planned = learner.next()
        check_limits(planned)
    assert errors[0] > 3e-3
    assert errors[2] < errors[0] / 4


def test_a_plan_that_is_expected_to_be_worse_is_not_played(first, monkeypatch):
    planned = Correction.plan

    def astray(correction, commands, disturbance, pull):
        found = planned(correction, commands, disturbance, pull)
        return replace(found, tip_predicted=found.tip_predicted + 0.1)

    monkeypatch.setattr(Correction, "plan", astray)
    learner = Learner(first)
    learner.add(first.time, play(first, other_limb()))
    assert learner.next() is first
    assert "expected to be better" in learner.stopped


def test_arcs_learn_as_the_rod_does():
    motion = Motion.named("same_direction", period=8.0, cycles=1)
    first = plan(LIMB, motion, model="pcc", method="paper")
    _, planned, errors = learn(first, other_limb(), 3)
    assert planned.model == "pcc"
    assert errors[2] < errors[0] / 3


def test_lost_tags_teach_nothing_wrong(first):
    limb = other_limb()
    tip = play(first, limb)
    lost = (first.time > 5.0) & (first.time < 8.0)
    learner = Learner(first)
    learner.add(first.time, np.where(lost[:, None], np.nan, tip))
    after = learner.next()
    before = np.linalg.norm(tip - first.tip_reference, axis=1)
    left = np.linalg.norm(play(after, limb) - first.tip_reference, axis=1)
    assert left[~lost].mean() < before[~lost].mean() / 2
    assert left[lost].max() < before[lost].max()
    assert learner.history[0].seen == pytest.approx(1 - lost.mean(), abs=0.03)


def test_a_run_that_was_vented_half_way_teaches_what_came_before(first):
    limb = other_limb()
    vented = first.differential_pressure.copy()
    vented[first.time > 6.0] = 0.0
    tip = simulate(limb, first.time, commands=vented).tip[:-1]
    learner = Learner(first)
    learner.add(first.time, tip)
    assert learner.history[0].accepted
    assert learner.history[0].seen < 0.6
    left = np.linalg.norm(play(learner.next(), limb) - first.tip_reference, axis=1)
    before = np.linalg.norm(play(first, limb) - first.tip_reference, axis=1)
    assert left.mean() < before.mean()


def test_a_run_that_saw_hardly_anything_is_refused(first, learned):
    tip = play(first, other_limb())
    learner = Learner(first)
    for given in (
        np.where((first.time > 1.0)[:, None], np.nan, tip),
        np.full_like(tip, np.nan),
        np.tile(tip[0], (len(tip), 1)),
    ):
        learner.add(first.time, given)
        assert not learner.history[-1].accepted
        assert "refused: the tip was seen" in learner.history[-1].reason
        assert learner.next() is first


def test_another_limb_is_set_aside_once_and_then_learned_from_the_start(learned_twice):
    learner, planned, errors = learned_twice
    swapped = other_limb(gain=0.65, rest=-0.05)
    learner.add(planned.time, play(planned, swapped))
    assert not learner.history[-1].accepted
    assert "set aside" in learner.history[-1].reason
    again = learner.next()
    assert mean_error(again, play(again, other_limb())) < 2 * min(errors)
    tip = play(again, swapped)
    learner.add(again.time, tip)
    assert learner.history[-1].accepted
    assert "the limb has changed" in learner.history[-1].reason
    after = learner.next()
    assert mean_error(after, play(after, swapped)) < mean_error(again, tip) / 2


def test_new_commands_whose_run_is_set_aside_are_not_played_again_as_they_were(first):
    learner, planned, _ = learn(first, other_limb(), 1)
    learner.add(planned.time, play(planned, other_limb()) + np.array([0.0, 0.08]))
    assert "set aside" in learner.history[-1].reason
    again = learner.next()
    best = first.differential_pressure
    np.testing.assert_array_equal(again.differential_pressure, best)
    learner.add(again.time, play(again, other_limb()))
    before, after = (
        np.abs(p.differential_pressure - best).mean() for p in (planned, learner.next())
    )
    assert 0.0 < after < 0.75 * before


def test_a_worse_plan_is_left_for_the_best_with_a_smaller_step(first, learned_twice):
    learner, planned, errors = learned_twice
    best = planned.differential_pressure
    learner.add(planned.time, play(planned, other_limb()))
    worse = 0.97 * best
    tip = simulate(other_limb(), planned.time, commands=worse).tip[:-1]
    learner.add(planned.time, tip, commands=worse)
    assert "back to it with a step of 0.50" in learner.history[-1].reason
    assert mean_error(first, play(learner.next(), other_limb())) <= errors[1]


def test_learning_stops_when_only_what_does_not_repeat_is_left(first):
    learner, rng = Learner(first), np.random.default_rng(3)
    tip = play(first, LIMB)
    for _ in range(6):
        wander = np.interp(first.time, [0, 4, 8, 15], rng.normal(scale=1e-3, size=4))
        learner.add(first.time, tip + wander[:, None] * [0.3, 1.0])
    assert 2e-4 < learner.repeatability < 2e-3
    assert "only noise is left" in learner.stopped
    assert learner.stopped in learner.history[-1].reason
    assert learner.next() is first


def test_what_passes_for_noise_is_tried_with_the_best_plan(first):
    """Each plan misses by something else, always the same: nothing of it is noise."""
    learner, planned, rng = Learner(first), first, np.random.default_rng(3)
    missed = {}
    for number in range(6):
        commands = planned.differential_pressure.tobytes()
        if commands not in missed:
            size = 6e-4 * 1.4**number
            missed[commands] = np.interp(first.time, [0, 4, 8, 15], rng.normal(scale=size, size=4))
        learner.add(planned.time, play(planned, LIMB) + missed[commands][:, None] * [0.3, 1.0])
        planned = learner.next()
        if "played again" in learner.history[-1].reason:
            break
    best = min(missed, key=lambda each: np.abs(missed[each]).mean())
    assert planned.differential_pressure.tobytes() == best
    assert len(missed) > 1


def test_an_uncertain_run_counts_for_less(first):
    tip = play(first, LIMB)
    shifts = []
    for deviation in (1e-4, 1e-2):
        learner = Learner(first)
        learner.add(first.time, tip)
        doubt = np.tile(np.eye(2) * deviation**2, (len(tip), 1, 1))
        learner.add(first.time, tip + np.array([0.0, 2e-3]), doubt)
        change = learner.next().differential_pressure - first.differential_pressure
        shifts.append(np.abs(change).mean())
    assert shifts[1] < shifts[0] / 2


def test_arrays_that_do_not_fit_are_refused(first):
    learner, tip = Learner(first), first.tip_reference
    for time, given, covariance, said in (
        (first.time[:-1], tip, None, "rising times"),
        (first.time[::-1], tip, None, "rising times"),
        (first.time, tip, np.eye(2), "covariance must have shape"),
        (first.time, 1000.0 * tip, None, "give metres"),
        (1000.0 * first.time, tip, None, "give seconds"),
    ):
        with pytest.raises(LearningError, match=said):
            learner.add(time, given, covariance)
    with pytest.raises(LearningError, match="commands must be finite"):
        learner.add(first.time, tip, commands=np.zeros((3, 2)))
    with pytest.raises(LearningError, match="give Pa"):
        learner.add(first.time, tip, commands=1e-3 * first.differential_pressure)
    assert learner.history == []


def test_a_limb_far_from_its_file_is_used_since_it_moves_with_its_commands(first):
    """It misses its path by more than half of the way nearly everywhere."""
    strange = other_limb(gain=1.7, rest=0.2)
    learner, _, errors = learn(first, strange, 2)
    assert errors[0] > 0.05
    assert learner.history[0].accepted
    assert "gains and rest angles of the model were taken from it" in learner.history[0].reason
    assert errors[1] < errors[0] / 20


def test_a_run_that_does_not_move_with_its_commands_is_refused(first):
    for limb, until in ((other_limb(), 1.2), (other_limb(), 2.5), (other_limb(1.4, 0.2), 2.5)):
        vented = first.differential_pressure.copy()
        vented[first.time > until] = 0.0
        learner = Learner(first)
        learner.add(first.time, simulate(limb, first.time, commands=vented).tip[:-1])
        assert not learner.history[0].accepted
        assert "refused" in learner.history[0].reason
    crossed = -0.7 * first.differential_pressure
    learner.add(first.time, simulate(other_limb(), first.time, commands=crossed).tip[:-1])
    assert "does not move with the commands" in learner.history[1].reason
    assert learner.next() is first


@pytest.mark.parametrize(
    ("turned", "reason"),
    [
        (lambda tip: tip[:, ::-1], "begins .* count from the clamp"),
        (lambda tip: 0.0 * tip, "begins .* count from the clamp"),
        (lambda tip: tip[0] + 0.0 * tip, "moved 0% of its way"),
        (lambda tip: np.concatenate([tip[:1].repeat(8, axis=0), tip[:-8]]), "are 0.4 s later"),
    ],
)
def test_tips_that_are_swapped_or_late_or_stand_still_teach_nothing(first, turned, reason):
    learner = Learner(first)
    learner.add(first.time, turned(first.tip_predicted))
    assert not learner.history[0].accepted
    assert re.search(reason, learner.history[0].reason)


def test_a_short_run_can_be_late_too(first):
    tip = first.tip_predicted[20:50]
    assert later(tip, tip) == 0
    assert later(first.tip_predicted[15:45], tip) == 5


def test_chambers_are_told_in_any_order_with_gaps_and_refused_where_they_do_not_fit(first):
    """What a learned plan knows of its chambers is their reading less the model's pressure."""
    tip = play(first, other_limb())
    time = np.concatenate([first.time, first.time + 0.02])
    model = simulate(LIMB, first.time, commands=first.differential_pressure)
    made = model.differential_pressure.mean(axis=1)
    held = np.tile(made, (2, 1)) + 1500.0
    mixed = np.random.default_rng(3).permutation(len(time))
    learner = Learner(first)
    with pytest.raises(LearningError, match=r"chambers need instants \(n,\) and pressures"):
        learner.add(first.time, tip, chambers=(time, held[:, :1]))
    with pytest.raises(LearningError, match="give Pa, segment by segment"):
        learner.add(first.time, tip, chambers=(time, 1e-3 * held))
    assert not learner.history
    held[7:40] = np.nan
    learner.add(first.time, tip, chambers=(time[mixed], held[mixed]))
    order = np.argsort(time)
    order = order[np.isfinite(held[order, 0])]
    middle = first.time + 0.5 * (first.time[1] - first.time[0])
    read = [np.interp(middle, time[order], column) for column in held[order].T]
    np.testing.assert_allclose(
        learner.next().chambers_beyond, np.stack(read, axis=1) - made, atol=1e-6
    )
    nothing = Learner(first)
    nothing.add(first.time, tip, chambers=(time, np.full_like(held, np.nan)))
    assert nothing.next().chambers_beyond is None


def test_of_chambers_after_their_last_reading_nothing_is_known(first):
    made = simulate(LIMB, first.time, commands=first.differential_pressure)
    held = made.differential_pressure.mean(axis=1) + 1500.0
    kept = len(held) // 2
    cut_short = Learner(first)
    cut_short.add(first.time, play(first, other_limb()), chambers=(first.time[:kept], held[:kept]))
    beyond = cut_short.next().chambers_beyond
    assert np.abs(beyond[1 : kept - 1]).mean() > 1000.0
    assert not beyond[kept:].any()
