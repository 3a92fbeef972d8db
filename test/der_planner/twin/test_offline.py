"""Pressures played on the twin without ROS."""

import numpy as np
import pytest

from der_planner.model.air import pair_of
from der_planner.twin import TwinError
from der_planner.twin.offline import LEAD, play
from pressure_driver.emulator.pneumatics import BoardPneumatics


def test_rows_are_what_was_before_the_setpoint():
    time = np.arange(40) * 0.05
    pressure = np.zeros((40, 2))
    pressure[10:, 0] = 6000.0
    result = play(time, pressure, seed=2)
    assert result.tip.shape == (40, 2)
    assert result.bend_angles.shape == result.measured_differential.shape == (40, 2)
    assert result.chamber_pressure.shape == (40, 4)
    still = result.bend_angles[:11]
    assert np.abs(still - still[0]).max() < np.deg2rad(0.2)
    np.testing.assert_allclose(result.measured_differential[:11], 0.0, atol=1e-9)
    assert result.bend_angles[-1, 0] > still[0, 0] + np.deg2rad(5.0)


def test_limb_feels_the_boards_pneumatics():
    time = np.arange(30) * 0.05
    pressure = np.tile([0.0, -4000.0], (30, 1))
    result = play(time, pressure, seed=3)
    air = BoardPneumatics(2, 3)
    for _ in range(round(LEAD / 0.01)):
        air.step(0.01)
    expected = []
    for row in pressure:
        expected.append(air.pressure)
        air.command(air.atmosphere + pair_of(row).ravel())
        for _ in range(5):
            air.step(0.01)
    np.testing.assert_allclose(result.chamber_pressure, expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("time", "pressure", "match"),
    [
        ([0.0, 0.05], np.zeros((3, 2)), "expected time"),
        ([0.0, 0.0], np.zeros((2, 2)), "rise"),
        ([0.0, 0.05], np.full((2, 2), np.nan), "finite"),
        ([0.0, 0.05], np.zeros((2, 3)), "segments"),
    ],
)
def test_bad_input_is_named(time, pressure, match):
    with pytest.raises(TwinError, match=match):
        play(time, pressure)
