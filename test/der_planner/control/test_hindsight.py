"""What a recorded run shows afterwards, on a chain of links whose true motion is known."""

import numpy as np
import pytest
from link_chain import TIP_NOISE, LinkChain

from der_planner.control.hindsight import Filmed, Smoothed, smooth
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
