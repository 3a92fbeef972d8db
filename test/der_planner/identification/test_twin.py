"""The whole procedure on the twin."""

import numpy as np
import pytest

from der_planner.identification import calibrate_twin, predict
from der_planner.identification.excitation import PERIOD, Excitation, record_twin
from der_planner.limb import Limb
from der_planner.twin.hardware import draw, known_values

pytestmark = pytest.mark.slow

SEED = 4


@pytest.fixture(scope="module")
def calibrated():
    """Return the calibrated limb and the fit's report."""
    return calibrate_twin(SEED, Limb.default())


def test_twin_is_predicted_after_one_calibration(calibrated):
    limb, report = calibrated
    assert np.degrees(report.residual).max() < 1.0
    time = np.arange(0, 30, PERIOD)
    pressure = 9000.0 * np.stack([1 - np.cos(time / 3), np.sin(time / 2)], axis=1)
    log = record_twin(SEED, Excitation(time, pressure), run=2)
    predicted = predict(limb, log.time, log.measured_differential)
    error = np.linalg.norm(predicted.tip - log.tip, axis=1) / limb.length
    assert error.mean() < 0.03
    assert error.max() < 0.08
    default = predict(Limb.default(), log.time, log.measured_differential)
    assert error.mean() < 0.5 * np.linalg.norm(default.tip - log.tip, axis=1).mean() / limb.length


def test_what_the_twin_knows_is_recovered_within_the_stated_uncertainty(calibrated):
    _, report = calibrated
    distances = {}
    for name, known in known_values(draw(SEED)).items():
        found = report.value(name)
        deviation = np.hypot(found.deviation, known.spread)
        distances[name] = abs(found.value - known.value) / deviation
    assert len(distances) == 18
    # Two thirds within one deviation, nineteen of twenty within two, if errors were all noise.
    values = np.array(list(distances.values()))
    assert np.mean(values < 1.0) > 0.5, distances
    assert np.mean(values < 2.0) > 0.9, distances
    assert values.max() < 4.0, distances
