"""Calibration of the twin in one process, in seconds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from der_planner.identification.excitation import Excitation, calibration_run
from der_planner.identification.fit import fit
from der_planner.identification.log import CalibrationLog
from der_planner.identification.report import FitReport
from der_planner.limb import Limb

ANGLE_NOISE = np.deg2rad(0.1)
"""Standard deviation of a bend angle from tags [rad]."""
TIP_NOISE = 3e-4
"""Standard deviation of a tip from tags [m]."""
PRESSURE_NOISE = 5.0
"""Standard deviation of the board's telemetry [Pa]."""
CALIBRATION_RUN = 1
"""The run of the twin that a calibration sees; experiments are run 0 of the same hardware."""
AMPLITUDE = 0.7
"""Share of the pressure limit that a calibration uses."""


def record_twin(
    seed: int,
    excitation: Excitation,
    run: int = CALIBRATION_RUN,
    noise: float = 1.0,
    limb: Limb | None = None,
) -> CalibrationLog:
    """Play an excitation on the twin and return what camera and board would have measured.

    Args:
        seed: of the hardware.
        excitation: pressures to play.
        run: of the same hardware.
        noise: factor on the sensors' noise.
        limb: the twin is mounted as this limb is, and carries its masses; None: no loads.
    """
    # PyElastica takes a second to import: only who plays pays for it.
    from der_planner.twin.offline import play  # noqa: PLC0415

    loads = limb or Limb.default()
    played = play(
        excitation.time,
        excitation.differential_pressure,
        seed,
        run=run,
        gravity=loads.gravity,
        masses=loads.masses,
    )
    generator = np.random.default_rng([seed, run])

    def noisy(values: np.ndarray, deviation: float) -> np.ndarray:
        return values + noise * deviation * generator.standard_normal(values.shape)

    return CalibrationLog(
        time=played.time,
        commanded_differential=played.commanded_differential,
        measured_differential=noisy(played.measured_differential, PRESSURE_NOISE),
        bend_angles=noisy(played.bend_angles, ANGLE_NOISE),
        tip=noisy(played.tip, TIP_NOISE),
        source=f"twin, seed {seed}, run {run}",
    )


def calibrate_twin(
    seed: int, prior: Limb, *, quick: bool = True, noise: float = 1.0
) -> tuple[Limb, FitReport]:
    """Run a calibration on the twin of a seed and fit the prior to it.

    Only what a camera and the board would measure is used, with their noise.

    Args:
        seed: of the hardware.
        prior: limb with the geometry, masses and limits, and first guesses of the rest; the twin is
            mounted as it is and carries its `masses`.
        quick: use the short run of a minute and a half instead of three minutes.
        noise: of tags and board, as a multiple of the usual one.

    Returns:
        The identified limb and what the fit says of it.

    Raises:
        LogError: the run does not tell the parameters.
    """
    amplitude = AMPLITUDE * prior.pneumatics.pressure_limit
    excitation = calibration_run(amplitude, prior.segment_count, quick)
    limb, report = fit(prior, record_twin(seed, excitation, noise=noise, limb=prior))
    return replace(limb, name=f"{prior.name}, twin {seed}"), report
