"""Logs with another unit are refused in one sentence."""

from dataclasses import replace

import numpy as np
import pytest

from der_planner.identification import CalibrationLog, LogError
from der_planner.identification.log import prepare
from der_planner.limb import Limb

LIMB = Limb.default()


def slow_log() -> CalibrationLog:
    """Return 30 s in which each segment bends slowly as its pressure says."""
    time = np.arange(0.0, 30.0, 0.05)
    pressure = np.stack([8e3 * np.sin(0.7 * time), 7e3 * np.sin(1.1 * time)], axis=1)
    bend = LIMB.static_gain * pressure
    tip = np.stack([0.24 - 0.02 * np.abs(bend).sum(axis=1), 0.1 * bend.sum(axis=1)], axis=1)
    return CalibrationLog(time, pressure.copy(), pressure, bend, tip)


DOORS = {
    "time in ms": (lambda log: {"time": 1e3 * log.time}, "a row every 50 s: give the time in sec"),
    "time in minutes": (lambda log: {"time": log.time / 3600.0}, "lasts 0.00832 s"),
    "degrees": (
        lambda log: {"bend_angles": np.degrees(log.bend_angles)},
        "give them in rad, or name angle_unit in columns.yaml",
    ),
    "hPa": (
        lambda log: {
            "measured_differential": 0.01 * log.measured_differential,
            "commanded_differential": 0.01 * log.commanded_differential,
        },
        r"name their unit in columns.yaml \(pressure_unit\)",
    ),
    "thousandths of Pa": (
        lambda log: {"measured_differential": 1e3 * log.measured_differential},
        "give them in Pa, or name pressure_unit in columns.yaml",
    ),
}


@pytest.mark.parametrize("door", DOORS)
def test_other_units_are_named(door):
    change, said = DOORS[door]
    log = slow_log()
    with pytest.raises(LogError, match=said):
        prepare(replace(log, **change(log)), LIMB, to_fit=False)


@pytest.mark.parametrize("wrong", [lambda tip: tip[:, ::-1], lambda tip: tip * [1.0, -1.0]])
def test_tips_in_other_axes_than_the_limbs_are_refused(wrong):
    log = slow_log()
    prepare(log, LIMB)
    with pytest.raises(LogError, match="x points along the straight limb"):
        prepare(replace(log, tip=wrong(log.tip)), LIMB)


def test_single_impossible_numbers_are_left_out_and_said():
    log = slow_log()
    log.bend_angles[100, 0], log.measured_differential[200, 1] = 1e9, -1e9
    log.tip[300] = 1e9
    prepared = prepare(log, LIMB, to_fit=False)
    assert len(prepared.warnings) == 3
    assert "1 rows have tips that no such limb has" in prepared.warnings[2]
    assert np.abs(prepared.bend).max() < 1.0
    assert np.abs(prepared.pressure).max() < 1e4
