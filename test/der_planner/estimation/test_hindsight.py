"""What a recorded run shows afterwards, and what feedback takes the chambers to hold next."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments
from link_chain import TIP_NOISE, LinkChain

from der_planner.estimation.estimator import Estimator
from der_planner.estimation.hindsight import Filmed, Smoothed, smooth
from der_planner.estimation.nominal import STEP, ChamberLog, Nominal
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, plan

DROP = 5.0
"""Instant from which the chain's gain is a fifth lower [s]."""


@pytest.fixture(scope="module")
def planned() -> Plan:
    return plan(Limb.default(), Motion.named("asynchronous", period=8.0, cycles=1))


@pytest.fixture(scope="module")
def smoothed(planned: Plan) -> tuple[Smoothed, np.ndarray, np.ndarray]:
    """Return what a noisy film shows, and the true tip (K, 2) and bend angles (K, M)."""
    record, truth = (
        LinkChain(3).play(
            planned.time, planned.differential_pressure, noise=noise, gains=((DROP, 0.8),)
        )
        for noise in (1.0, 0.0)
    )
    tip, bend = record.tip.copy(), record.bend_angles.copy()
    tip[60:75], bend[60:75] = np.nan, np.nan  # half a second in which the limb is not seen
    shown = smooth(
        planned, Filmed(record.time, record.measured_differential, record.time, bend, tip)
    )
    true_tip, true_bend = (
        np.column_stack([np.interp(shown.time, truth.time, x) for x in values.T])
        for values in (truth.tip, truth.bend_angles)
    )
    return shown, true_tip, true_bend


def test_the_smoothed_tip_is_better_than_the_pictures(smoothed):
    shown, tip, bend = smoothed
    away = np.linalg.norm(shown.tip - tip, axis=1)
    assert np.sqrt(np.mean(away**2)) < 0.8 * np.sqrt(2) * TIP_NOISE
    assert away.max() < 3e-3
    assert np.sqrt(np.mean((shown.bend_angle - bend) ** 2)) < np.deg2rad(0.3)


def test_its_covariance_says_how_good_it_is(smoothed):
    shown, tip, _ = smoothed
    assert 0.2 < shown.consistency(shown.time, tip) < 2.0
    assert 0.3 < shown.innovation < 1.5
    spread = np.sqrt(np.trace(shown.tip_covariance, axis1=1, axis2=2))
    unseen = (shown.time > 2.15) & (shown.time < 2.35)
    assert spread[unseen].min() > 1.5 * np.median(spread)


def test_a_gain_that_dropped_is_found_where_it_did(smoothed):
    shown, *_ = smoothed
    before = shown.gain_error[(shown.time > 3.0) & (shown.time < 4.5)].mean(axis=0)
    after = shown.gain_error[shown.time > 6.5].mean(axis=0)
    assert np.all(after - before < -0.05)


def test_a_run_without_pictures_is_refused(planned):
    time = np.arange(20) * 0.05
    nothing = np.full((20, 2), np.nan)
    with pytest.raises(ValueError, match="no picture of the limb"):
        smooth(planned, Filmed(time, np.zeros((20, 2)), time, nothing, nothing))


def test_friction_remembers_how_the_limb_bends_and_not_how_it_was_planned_to():
    limb = with_segments(
        Limb.default().mounted("45"),
        friction_moment=lambda s: 900.0 * s.moment_gain,
        friction_curvature=0.25,
    )
    planned = plan(limb, Motion.named("asynchronous", amplitude=0.3, period=12.0, cycles=1))
    nominal = Nominal(planned)
    estimator = Estimator(nominal, ChamberLog(nominal))
    seen, _, tips = nominal.at(planned.time)
    # Near the straight limb other bends have the same tip.
    assert np.abs(seen - planned.bend_angles).max() > np.deg2rad(2.5)
    away = []
    for time, bend, tip in zip(planned.time, seen, tips, strict=True):
        estimator.measure(time, bend, tip, None)
        away.append(estimator.at(time).memory.bend - bend)
    assert np.abs(away).max() < np.deg2rad(0.5)


FALLS_BEHIND = 500.0
"""[Pa/s]"""


@pytest.fixture(scope="module")
def nominal() -> Nominal:
    """Return the motion of a plan of the default limb."""
    motion = Motion.named("same_direction", amplitude=0.5, period=8.0, cycles=1)
    return Nominal(plan(Limb.default(), motion, method="projected"))


def ahead(nominal: Nominal, readings: int) -> float:
    """Return how wrong the pressures 0.3 s ahead are [Pa] after so many readings until 2.6 s.

    The real chambers fall behind their model by another `FALLS_BEHIND` each second.
    """

    def real(steps: np.ndarray) -> np.ndarray:
        lag = FALLS_BEHIND * (STEP * (steps + 0.5) - 2.0)
        return ChamberLog(nominal).model(steps) - lag[:, None]

    log = ChamberLog(nominal)
    for step in 259 - 5 * np.arange(readings)[::-1]:
        log.read(STEP * (step + 0.5), real(np.array([step]))[0])
    coming = np.array([289])
    return float(np.abs(log.during(coming) - real(coming)).max())


def test_chambers_that_fall_behind_are_expected_to_fall_behind_further(nominal):
    assert ahead(nominal, 1) > 0.2 * FALLS_BEHIND
    assert ahead(nominal, 7) < 0.4 * ahead(nominal, 1)


def test_after_a_long_time_the_model_counts_again(nominal):
    log = ChamberLog(nominal)
    steps = np.arange(60)
    for k in range(8):
        log.read(0.05 * k, log.model(np.array([5 * k]))[0] + 200.0 + 300.0 * 0.05 * k)
    gap = log.expected_gap(log.newest + np.array([0.0, 0.5, 20.0]))
    assert gap[0] == pytest.approx(305.0, abs=2.0)
    assert np.all(gap[1] > gap[0])
    assert np.abs(gap[2]).max() < 200.0
    assert np.isfinite(log.during(steps)).all()


@pytest.mark.slow
def test_what_a_learned_plan_knows_of_its_chambers_is_not_corrected_again():
    motion = Motion.named("same_direction", amplitude=0.5, period=8.0, cycles=1)
    planned = replace(plan(Limb.default(), motion, method="projected"), method="learned")
    beyond = 200.0 + 5.0 * np.arange(len(planned.time))[:, None] * np.array([1.0, -1.0])
    told = Nominal(replace(planned, chambers_beyond=beyond))
    steps = np.arange(60)
    news = {}
    for name, nominal in (("told", told), ("not told", Nominal(planned))):
        log = ChamberLog(nominal)
        for k in range(8):
            # Amid the first step of period k the chambers are a tenth of a period into it.
            share = beyond[k] - 0.4 * (beyond[k + 1] - beyond[k])
            log.read(STEP * (5 * k + 0.5), log.model(np.array([5 * k]))[0] + share + 30.0)
        news[name] = log.during(steps) - log.model(steps)
    # Only what is more than expected counts; nothing does where nobody told what to expect.
    np.testing.assert_allclose(news["told"][:36], 30.0, atol=10.0)
    assert np.abs(news["told"][40:] - 30.0).max() < 25.0
    assert not news["not told"].any()
