"""Calibration of the twin in one process, in seconds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.excitation import staircase
from der_planner.identification.log import CalibrationLog
from der_planner.identification.statics import resting_points, static_gain, with_statics
from der_planner.limb import CalibratedRange, Limb

Array = NDArray[np.float64]

ANGLE_NOISE = np.deg2rad(0.1)
TIP_NOISE = 3e-4
PRESSURE_NOISE = 10.0
CALIBRATION_RUN = 1
"""The run of the twin that a calibration sees; experiments are run 0 of the same hardware."""


@dataclass(frozen=True)
class CalibrationReport:
    """What a calibration found.

    Attributes:
        gain: (M,) bend angle per differential pressure [rad/Pa].
        rest_angle: (M,) [rad].
        residual: root mean square of measured less fitted bend angles at rest [rad].
        excitation_time: length of the run [s].
    """

    gain: Array
    rest_angle: Array
    residual: float
    excitation_time: float


def calibrate_twin(seed: int, prior: Limb) -> tuple[Limb, CalibrationReport]:
    """Run a calibration on the twin of a seed and fit the prior to it.

    Only what a camera and the board would measure is used, with their noise.

    Args:
        seed: of the hardware.
        prior: limb with the geometry, masses and limits, whose gains and rest angles are replaced.

    Raises:
        LogError: the run does not tell the parameters.
    """
    from der_planner.twin.offline import play

    excitation = staircase(0.6 * prior.pneumatics.pressure_limit, prior.segment_count)
    played = play(
        excitation.time, excitation.differential_pressure, seed, run=CALIBRATION_RUN, lead=1.0
    )
    noise = np.random.default_rng([seed, CALIBRATION_RUN])
    angles, tip = played.bend_angles, played.tip
    pressure = played.measured_differential
    log = CalibrationLog(
        time=played.time,
        commanded_differential=played.commanded_differential,
        measured_differential=pressure + PRESSURE_NOISE * noise.standard_normal(pressure.shape),
        bend_angles=angles + ANGLE_NOISE * noise.standard_normal(angles.shape),
        tip=tip + TIP_NOISE * noise.standard_normal(tip.shape),
        source=f"twin, seed {seed}",
    )
    pressures, resting = resting_points(log, excitation.stairs)
    gains, rests = static_gain(pressures, resting)
    residual = resting - (pressures * gains + rests)
    limb = replace(
        with_statics(prior, gains, rests),
        calibrated=CalibratedRange(
            tuple(float(v) for v in np.abs(pressures).max(axis=0)),
            tuple(float(v) for v in np.abs(resting).max(axis=0)),
        ),
        provenance={"source": log.source, "procedure": "staircase, statics in closed form"},
    )
    report = CalibrationReport(
        gains, rests, float(np.sqrt(np.mean(residual**2))), float(excitation.time[-1])
    )
    return limb, report
