"""Feedback on limbs that the model does not know: chains of links, with the default limb's file."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import of_pressures, with_segments
from link_chain import LinkChain

from der_planner.control import Feedback, Learner
from der_planner.control.lockstep import Played, Sensors, play
from der_planner.control.supervisor import Supervisor
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, plan
from der_planner.planning.streaming import Schedule

pytestmark = pytest.mark.slow

LENGTH = 0.244


class Chain:
    """A chain of links as a plant; what it feels may be changed on the way.

    All its pressures may be larger by a factor.
    """

    def __init__(self, seed: int = 3, pressures: float = 1.0) -> None:
        self.chain, self._factor = LinkChain(seed), pressures
        self._seen = self.chain.reset()

    def advance(self, command: np.ndarray, duration: float) -> None:
        self._seen = self.chain.advance(command / self._factor, duration)

    @property
    def differential_pressure(self) -> np.ndarray:
        return self._factor * self._seen.differential_pressure

    @property
    def bend_angles(self) -> np.ndarray:
        return self._seen.bend_angles

    @property
    def tip(self) -> np.ndarray:
        return self._seen.tip


@pytest.fixture(scope="module")
def planned() -> Plan:
    """Return a plan made with a limb file that no calibration has touched."""
    return plan(Limb.default(), Motion.named("asynchronous", period=12.0, cycles=1))


def play_watched(planned: Plan, feedback: Feedback) -> tuple[Played, np.ndarray]:
    """Return a run with feedback on the chain, and the share that was sent, by period."""
    share = np.zeros(len(planned.time) + 1)

    def event(time: float) -> None:
        share[int(20 * time + 1e-6)] = feedback.share

    return play(planned, Chain(), feedback, event=event), share


@pytest.fixture(scope="module")
def corrected(planned: Plan) -> tuple[Played, Feedback, np.ndarray]:
    """Return such a run, its feedback and its shares."""
    feedback = Feedback(planned)
    played, share = play_watched(planned, feedback)
    return played, feedback, share


def test_a_limb_that_was_never_calibrated_is_followed(planned, corrected):
    played, feedback, _ = corrected
    alone = play(planned, Chain())
    after = played.time > 1.0
    assert alone.error[after].mean() > 0.02 * LENGTH
    assert played.error[after].mean() < 0.012 * LENGTH
    assert played.error[after].mean() < 0.6 * alone.error[after].mean()
    assert not feedback.warnings


@pytest.mark.parametrize("factor", [0.2, 12.0])
def test_a_limb_of_other_pressures_is_corrected_alike(planned, corrected, factor):
    played, feedback, _ = corrected
    motion = Motion.named("asynchronous", period=12.0, cycles=1)
    alike = plan(of_pressures(planned.limb, factor), motion)
    alike_feedback = Feedback(alike)
    sensors = Sensors(pressure_noise=factor * Sensors().pressure_noise)
    found = play(alike, Chain(pressures=factor), alike_feedback, sensors)
    np.testing.assert_allclose(alike.tip_predicted, planned.tip_predicted, atol=2e-5)
    np.testing.assert_allclose(found.correction / factor, played.correction, atol=50.0)
    np.testing.assert_allclose(found.tip, played.tip, atol=2e-4)
    assert alike_feedback.touch.distance == pytest.approx(feedback.touch.distance, abs=0.02)


def test_commands_keep_all_limits(planned, corrected):
    played, *_ = corrected
    air = planned.limb.pneumatics
    assert np.abs(played.commanded).max() <= air.pressure_limit
    steps = np.diff(played.commanded, axis=0, prepend=np.zeros((1, 2)))
    assert np.abs(steps).max() <= air.slew_limit * 0.05 + 1e-6
    ramp = np.minimum(1.0, (played.time + 0.05) / 1.0)
    assert np.all(np.abs(played.correction).max(axis=1) <= 0.4 * air.pressure_limit * ramp + 1.0)


def test_a_limb_that_swings_otherwise_than_its_model_is_followed_and_not_made_worse():
    # Bends at rest are those of the chain, its file is four times too soft.
    chain, segment = Chain().chain, Limb.default().segments[0]
    stiffness = 0.25 * segment.bending_stiffness
    bend = chain._gain.mean(axis=1) * (1.0 / chain._stiffness.reshape(2, -1)).sum(axis=1)
    limb = with_segments(
        Limb.default(),
        bending_stiffness=stiffness,
        rest_curvature=list(chain._rest / segment.length),
        moment_gain=list(bend * stiffness / segment.length),
    )
    fast = plan(limb, Motion.named("asynchronous", amplitude=0.6, period=6.0, cycles=1))
    alone, fed = (play(fast, Chain(), feedback) for feedback in (None, Feedback(fast)))
    assert fed.error.mean() < 1.02 * alone.error.mean()
    slow = plan(limb, Motion.named("asynchronous", amplitude=0.8, period=20.0, cycles=1))
    feedback = Feedback(slow)
    alone, fed = play(slow, Chain()), play(slow, Chain(), feedback)
    assert feedback.warnings[0].name == "swings"
    assert feedback.estimate(20.0).stiffness_ratio > 2.5
    assert fed.error.mean() < 0.7 * alone.error.mean()
    # The next run knows how stiff it is: its corrections need not be slow.
    again = Feedback(slow)
    again.remember(feedback)
    assert play(slow, Chain(), again).error.mean() < 0.6 * fed.error.mean()


def test_feedback_and_learning_do_not_fight(planned):
    learner, following = Learner(planned), planned
    draw = np.random.default_rng(4)
    for _ in range(2):
        run = play(following, Chain())
        tip = run.tip + 5e-5 * draw.standard_normal(run.tip.shape)
        learner.add(run.time, tip, chambers=(run.time, run.differential_pressure))
        following = learner.next()
    alone = play(following, Chain()).error.mean()
    assert alone < 0.005 * LENGTH
    feedback = Feedback(following)
    assert play(following, Chain(), feedback).error.mean() < 1.6 * alone
    assert not feedback.warnings


def test_the_estimate_knows_how_good_it_is(corrected):
    played, feedback, _ = corrected
    missed = np.linalg.norm(played.estimated_tip - played.tip, axis=1)[played.time > 1.0]
    assert np.sqrt(np.mean(missed**2)) < 1.5e-3
    told = feedback.estimate(7.0)
    assert 1e-5 < np.sqrt(np.trace(told.tip_covariance)) < 2e-3


def test_order_of_arrival_does_not_matter(planned):
    generator = np.random.default_rng(5)
    pictures = [
        (0.033 * k, 0.01 * generator.standard_normal(2), [0.24, 0.002 * k]) for k in range(40)
    ]
    answers = []
    late = np.argsort(np.arange(40) + generator.uniform(0.0, 20.0, 40))
    for order in (np.arange(40), late):
        feedback = Feedback(planned)
        for k in range(28):
            feedback.pressures(0.05 * k, planned.differential_pressure[k] * 0.8)
        feedback.measure(*pictures[0])
        for k in order[order > 0]:
            feedback.measure(*pictures[k])
            feedback.estimate(0.8)
        answers.append(feedback.estimate(1.4))
    np.testing.assert_allclose(answers[0].bend_angle, answers[1].bend_angle, atol=1e-10)
    np.testing.assert_allclose(answers[0].missing_pressure, answers[1].missing_pressure, atol=1e-5)
    assert np.abs(answers[0].missing_pressure).max() > 10.0


def test_a_gain_that_drops_is_made_up_for(planned, corrected):
    plant = Chain()

    def event(time: float) -> None:
        if abs(time - 4.0) < 1e-6:
            plant.chain.change_gain(0.8)

    played = play(planned, plant, Feedback(planned), event=event)
    without = corrected[0]
    hit = (played.time > 4.2) & (played.time < 5.0)
    assert played.error[hit].max() > without.error[hit].max() + 0.004
    late = played.time > 8.0
    assert played.error[late].mean() < 1.3 * without.error[late].mean()


def test_another_motion_takes_over_without_a_jump(planned):
    plant, first = Chain(), Feedback(planned)
    plant.chain.change_gain(0.8)
    for k in range(100):
        first.pressures(0.05 * k, plant.differential_pressure)
        first.measure(0.05 * k, plant.bend_angles, plant.tip)
        last = first.command(0.05 * k)
        plant.advance(last, 0.05)
    correction = last - planned.differential_pressure[99]
    assert np.abs(correction).max() > 500.0
    start = Schedule("left", planned, 0).leave(5_000_000_000)
    motion = Motion.named("same_direction", amplitude=0.4, period=8.0, cycles=1)
    following = plan(planned.limb, motion, method="projected", start=start)
    second = Feedback(following)
    second.take_over(first, 5.0)
    errors = []
    for k in range(60):
        second.pressures(0.05 * k, plant.differential_pressure)
        second.measure(0.05 * k, plant.bend_angles, plant.tip)
        command = second.command(0.05 * k)
        if k == 0:
            np.testing.assert_allclose(
                command - following.differential_pressure[0], correction, atol=400.0
            )
        plant.advance(command, 0.05)
        errors.append(np.linalg.norm(plant.tip - following.tip_reference[k + 1]))
    assert second.share > 0.8
    assert not second.warnings
    assert np.mean(errors) < 0.025 * LENGTH


def test_the_next_run_remembers_what_corrections_bring_once_it_has_left_its_rest(
    planned, corrected
):
    first, earlier, before = corrected
    feedback = Feedback(planned)
    feedback.remember(earlier)
    second, share = play_watched(planned, feedback)
    moved = planned.reference.bend_angles - planned.reference.bend_angles[0]
    leaves = int(np.argmax(np.abs(moved).max(axis=1) > 0.1))
    np.testing.assert_array_equal(share[:leaves], before[:leaves])
    assert share[100] > before[100] + 0.15
    assert second.error.mean() < 0.9 * first.error.mean()


def test_lost_tags_lead_back_to_the_plan(planned):
    plant = Chain()
    plant.chain.change_gain(0.7)
    feedback = Feedback(planned)
    sensors = Sensors(seen=lambda time: not 5.0 < time < 9.5)
    played = play(planned, plant, feedback, sensors)
    assert [warned.name for warned in feedback.warnings] == ["tags lost"]
    correction = np.abs(played.correction).max(axis=1)
    assert correction[round(5.2 / 0.05)] > 300.0
    assert correction[round(8.9 / 0.05)] < 1.0
    assert feedback.reason == ""
    assert correction[-1] > 100.0


def test_one_bad_picture_does_not_end_feedback(planned, monkeypatch):
    feedback = Feedback(planned)
    measure, bad = feedback.measure, []

    def seen(time, bend_angle, tip, *more):
        if not bad and time > 6.0:
            bad.append(time)
            tip = tip + 0.3
        measure(time, bend_angle, tip, *more)

    monkeypatch.setattr(feedback, "measure", seen)
    play(planned, Chain(), feedback, Sensors())
    assert len(bad) == 1
    assert feedback.warnings == []


def test_correcting_a_limb_that_does_not_follow_does_no_harm(planned):
    plant, other = Chain(), Chain()
    plant.chain.change_gain(0.1)
    other.chain.change_gain(0.1)
    corrected, alone = play(planned, plant, Feedback(planned)), play(planned, other)
    assert corrected.error.mean() < alone.error.mean()


def test_a_limb_that_needs_much_and_follows_is_not_left(planned):
    plant = Chain()
    plant.chain.change_gain(0.5)
    feedback = Feedback(planned)
    played = play(planned, plant, feedback)
    authority = 0.4 * planned.limb.pneumatics.pressure_limit
    at_limit = np.abs(played.correction).max(axis=1) > 0.98 * authority
    assert at_limit.sum() > 10
    assert not feedback.warnings


def test_what_is_fast_in_corrections_that_swing_is_taken_off_and_the_rest_stays():
    time = 0.05 * np.arange(200)
    turned = 3000.0 * (time > 4.0) * np.exp(-np.maximum(time - 4.0, 0.0))
    wave, follows = np.sin(2 * np.pi * 1.2 * time), 4000.0 * np.sin(2 * np.pi * time / 3.0)
    quiet = [(wanted, False) for wanted in (100.0 * wave, turned, follows)]
    for wanted, swings in [(1500.0 * wave, True), *quiet]:
        watch = Supervisor(authority=9600.0)
        pairs = np.column_stack([np.zeros(200), 4000.0 + wanted])
        sent = np.array([watch.calmed(*each) for each in zip(time[:170], pairs, strict=False)])
        ahead = watch.calmed_ahead(pairs[169:])
        rest = [watch.calmed(*each) for each in zip(time[170:], pairs[170:], strict=True)]
        np.testing.assert_allclose(ahead, [sent[-1], *rest])
        sent = np.concatenate([sent, rest])
        assert bool(watch.warnings) == swings
        if not swings:
            np.testing.assert_allclose(sent, pairs)
        else:
            assert sent[100:, 1].mean() == pytest.approx(4000.0, rel=0.02)
            assert np.ptp(sent[100:, 1]) < 0.4 * np.ptp(wanted)


def test_pushes_do_not_end_feedback_and_die_no_later(planned, corrected):
    def pushed(feedback: Feedback | None) -> Played:
        plant = Chain()

        def event(time: float) -> None:
            pushed = 4.0 <= time < 4.2 or 8.0 <= time < 8.2
            plant.chain.push(LENGTH, (0.0, 0.3 if pushed else 0.0))

        return play(planned, plant, feedback, event=event)

    def swing(after: Played, before: Played) -> int:
        """Return how many periods of the first push stand out."""
        apart = np.linalg.norm(after.tip - before.tip, axis=1)[:160]
        assert apart.max() > 0.01
        return int(np.nonzero(apart > 0.2 * apart.max())[0][-1])

    feedback = Feedback(planned)
    played = pushed(feedback)
    assert not feedback.warnings
    assert feedback.share > 0.6
    largest = played.error[80:100].max()
    assert largest > 0.02
    assert played.error[115:140].max() < 0.5 * largest
    assert swing(played, corrected[0]) <= swing(pushed(None), play(planned, Chain()))


def test_tips_in_millimetres_and_bend_angles_in_degrees_count_as_not_seen(planned):
    feedback = Feedback(planned)
    for k, tip in enumerate(planned.tip_predicted[:60]):
        feedback.measure(0.05 * k, np.rad2deg([0.5, 0.5]), 1e3 * tip)
        feedback.command(0.05 * (k + 2))
    np.testing.assert_allclose(feedback.estimate(3.0).tip, planned.tip_predicted[60], atol=1e-3)
    assert feedback.share == 0.0


def test_commands_that_are_asked_for_too_late_end_feedback(planned):
    feedback = Feedback(planned)
    for k in range(40):
        feedback.pressures(0.05 * k, [0.0, 0.0])
        feedback.measure(0.05 * k, [0.01, 0.01], [0.243, 0.003])
        feedback.command(0.05 * (k + 2 if k < 20 else k - 2))
    assert feedback.reason == "late"
    assert "after their instant" in feedback.warnings[0].message


def test_one_segment_and_three(planned):
    for count in (1, 3):
        segments = tuple(planned.limb.segments[0] for _ in range(count))
        limb = replace(planned.limb, segments=segments)
        motion = Motion.named("same_direction", amplitude=0.3, period=4.0, cycles=1)
        feedback = Feedback(plan(limb, motion, method="projected"))
        feedback.measure(0.0, np.full(count, 0.05), [np.nan, np.nan])
        command = feedback.command(0.2)
        assert command.shape == (count,)
        assert np.isfinite(command).all()


def test_a_wrong_shape_is_refused(planned):
    feedback = Feedback(planned)
    with pytest.raises(ValueError, match="2 bend angles"):
        feedback.measure(0.0, [0.0], [0.0, 0.0])
    with pytest.raises(ValueError, match="2 bend angles"):
        feedback.measure(0.0, [0.0, 0.0, 0.0], [0.0])
    with pytest.raises(ValueError, match="covariance"):
        feedback.measure(0.0, [0.0, 0.0], [0.0, 0.0], np.eye(3))
    for wrong in (-np.eye(2), [[1e-8, 1.0], [1.0, 1e-8]]):
        with pytest.raises(ValueError, match="variances that are not negative"):
            feedback.measure(0.0, [0.0, 0.0], [0.0, 0.0], wrong)
    for command in ([0.0], [np.nan, 0.0]):
        with pytest.raises(ValueError, match="one pressure a segment"):
            feedback.sent(0.0, command)
    with pytest.raises(ValueError, match="2 differential pressures"):
        feedback.pressures(0.0, [0.0])


@pytest.mark.parametrize("time", [1.7e9, 50.0, np.nan])
def test_times_of_another_clock_are_refused(planned, time):
    feedback, zero = Feedback(planned), np.zeros(2)
    for tell in (
        lambda: feedback.pressures(time, zero),
        lambda: feedback.measure(time, zero, zero),
        lambda: feedback.command(time),
        lambda: feedback.sent(time, zero),
        lambda: feedback.estimate(time),
        lambda: feedback.late(time, 0.1),
    ):
        with pytest.raises(ValueError, match="seconds since its first setpoint"):
            tell()


def test_pressures_in_another_unit_end_feedback(planned):
    feedback = Feedback(planned)
    for time in 0.05 * np.arange(160):
        feedback.pressures(time, 1e-3 * feedback.command(time))
    assert feedback.reason == "pressures"
    assert "told in Pa" in feedback.warnings[-1].message
