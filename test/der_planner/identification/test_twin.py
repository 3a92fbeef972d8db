"""The whole procedure: on the twin, and on numbers of a real limb where they are at hand."""

import numpy as np
import pytest

from der_planner.identification import (
    ColumnMap,
    calibrate_twin,
    check,
    fit,
    predict,
    read_csv,
    update,
)
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
    log = record_twin(SEED, Excitation(pressure), run=2)
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


REAL = ColumnMap(
    time="t",
    commanded=("u0", "u1"),
    chambers=("p0", "p1", "p2", "p3"),
    angles=("theta0", "theta1"),
    tags=("x103", "y103", "x104", "y104"),
    pressure_unit="hPa",
    angle_unit="deg",
    angle_factor=2.0,
    rest_until=12.0,
    ignore=((1.5, 3.0),),
)


@pytest.fixture(scope="module")
def real_limb(shared_data):
    log = read_csv(shared_data / "real_limb" / "A_calibration.csv", REAL)
    # The log is too slow to tell creep and dynamics apart from the rest.
    terms = ("asymmetry", "stiffening", "coupling", "friction")
    return fit(Limb.default(), log, terms=terms, longest_gap=10.0)


def test_real_limb_is_fitted(real_limb):
    limb, report = real_limb
    assert np.degrees(report.residual).max() < 1.0
    gains = np.degrees(limb.static_gain) * 100
    assert 0.22 < gains[1] < gains[0] < 0.50 or gains[1] == pytest.approx(0.21, abs=0.02)
    assert any("always move together" in warning for warning in report.warnings)


def test_real_limb_of_another_day_is_known_after_some_seconds(real_limb, shared_data):
    limb, _ = real_limb
    run = read_csv(shared_data / "real_limb" / "C_trajectory.csv", REAL)
    found, _ = update(limb, run.between(0.0, 20.0))
    later = run.between(20.0, 30.0)
    assert np.degrees(check(limb, later).error).max() > 3.0
    assert np.degrees(check(found, later).error).max() < 3.0
