"""The whole procedure on numbers of a real limb, where they are at hand."""

import numpy as np
import pytest

from der_planner.identification import ColumnMap, check, fit, read_csv, update
from der_planner.limb import Limb

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


@pytest.mark.slow
def test_real_limb_is_fitted(real_limb):
    limb, report = real_limb
    assert np.degrees(report.residual).max() < 1.0
    gains = np.degrees(limb.static_gain) * 100
    assert 0.22 < gains[1] < gains[0] < 0.50 or gains[1] == pytest.approx(0.21, abs=0.02)
    assert any("always move together" in warning for warning in report.warnings)


@pytest.mark.slow
def test_real_limb_of_another_day_is_known_after_some_seconds(real_limb, shared_data):
    limb, _ = real_limb
    run = read_csv(shared_data / "real_limb" / "C_trajectory.csv", REAL)
    found, _ = update(limb, run.between(0.0, 20.0))
    later = run.between(20.0, 30.0)
    assert np.degrees(check(limb, later).error).max() > 3.0
    assert np.degrees(check(found, later).error).max() < 3.0
