"""What is predicted keeps its weight; what is not loses it."""

import numpy as np
import pytest

from der_planner.control.estimation import Estimator
from der_planner.control.foresight import Foresight, Trust
from der_planner.control.nominal import ChamberLog, Nominal
from der_planner.limb import Limb
from der_planner.planning import CONTROL_PERIOD, Motion, plan

TIME = CONTROL_PERIOD * np.arange(200)
SWING = 0.02 * np.cos(7.5 * TIME)


def trusted(seen, parts):
    """Return the weights after predictions (K, 3) of what was seen (K,), of one segment."""
    trust = Trust(1)
    for part, value in zip(parts, seen, strict=True):
        trust.learn(part[:, None], np.array([value]))
    return trust.weights[:, 0]


def test_a_swing_that_the_model_does_not_foresee_is_not_trusted():
    slow, nothing = 0.05 * np.sin(0.3 * TIME), np.zeros_like(TIME)
    parts = np.stack([SWING, slow, nothing], axis=1)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(len(TIME))
    assert trusted(SWING + slow + noise, parts).min() > 0.95
    swing, kept, unused = trusted(0.02 * np.cos(11.0 * TIME) + slow + noise, parts)
    assert swing < 0.35
    assert kept > 0.9
    assert unused == 1.0


def test_a_single_push_takes_no_trust_away():
    parts = np.stack([SWING, 0.1 * SWING, 0.0 * SWING], axis=1)
    seen = parts.sum(axis=1)
    seen[100:104] += 0.1
    assert trusted(seen, parts).min() > 0.85


@pytest.fixture(scope="module")
def nominal():
    motion = Motion.named("same_direction", amplitude=0.02, period=3.0, cycles=1)
    return Nominal(plan(Limb.default(), motion, method="projected"))


def watched(nominal, speed):
    """Return the foresight of a limb that swings as the model does, but so many times as fast."""
    estimator = Estimator(nominal, ChamberLog(nominal))
    foresight = Foresight(nominal, estimator)
    state = np.array([0.10, 0.04, 0.0, 0.0])
    move = np.linalg.matrix_power(nominal.transition[0], speed)
    for k in range(60):
        bend, _, _ = nominal.at(k * CONTROL_PERIOD)
        estimator.measure(k * CONTROL_PERIOD, bend + state[:2], [np.nan, np.nan], None)
        known = estimator.at((k + 3) * CONTROL_PERIOD)
        foresight.learn()
        state = move @ state
    return foresight, known, k + 3


def test_the_swing_of_the_model_itself_is_foreseen(nominal):
    foresight, known, k = watched(nominal, speed=1)
    assert foresight.trust.weights[0].min() > 0.9
    foresight.trust.weights[:] = 1.0
    np.testing.assert_allclose(foresight.weighed(known, k).mean, known.mean, atol=1e-12)


def test_a_limb_four_times_as_stiff_is_corrected_for_what_is_slow_alone(nominal):
    foresight, known, k = watched(nominal, speed=2)
    assert foresight.trust.weights[0].max() < 0.5
    foresight.trust.weights[:] = [[0.0] * 2, [1.0] * 2, [0.0] * 2]
    weighed = foresight.weighed(known, k)
    assert np.abs(weighed.parts[1]).max() < 1e-3
