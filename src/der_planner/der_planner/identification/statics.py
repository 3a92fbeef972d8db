"""Start values in closed form: gain and rest angle of each segment from a staircase."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.log import CalibrationLog, LogError
from der_planner.limb import Limb

Array = NDArray[np.float64]

LEAST_EXCITATION = 1000.0
"""Standard deviation of an input below which its gain cannot be told [Pa]."""


def resting_points(log: CalibrationLog, intervals: Array) -> tuple[Array, Array]:
    """Return mean pressures and bend angles (S, M) [Pa], [rad] of intervals (S, 2) [s].

    Intervals without a single valid row are left out.
    """
    valid = np.all(np.isfinite(log.bend_angles), axis=1)
    valid &= np.all(np.isfinite(log.measured_differential), axis=1)
    pressure, angle = [], []
    for first, last in intervals:
        rows = valid & (log.time >= first) & (log.time <= last)
        if rows.any():
            pressure.append(log.measured_differential[rows].mean(axis=0))
            angle.append(log.bend_angles[rows].mean(axis=0))
    return np.array(pressure), np.array(angle)


def static_gain(pressure: Array, angle: Array) -> tuple[Array, Array]:
    """Fit angle = gain · pressure + rest for each segment.

    A planar limb without gravity bends each segment by its own couple alone, so the segments
    decouple.

    Args:
        pressure: (S, M) [Pa].
        angle: (S, M) [rad].

    Returns:
        Gains (M,) [rad/Pa] and rest angles (M,) [rad].

    Raises:
        LogError: an input was not excited.
    """
    if len(pressure) < 3:
        raise LogError(f"only {len(pressure)} resting points: run the whole staircase")
    gains, rests = np.empty(pressure.shape[1]), np.empty(pressure.shape[1])
    for index in range(pressure.shape[1]):
        if np.std(pressure[:, index]) < LEAST_EXCITATION:
            raise LogError(
                f"input {index} was not excited (standard deviation "
                f"{np.std(pressure[:, index]):.0f} Pa): its gain cannot be told"
            )
        gains[index], rests[index] = np.polyfit(pressure[:, index], angle[:, index], 1)
    return gains, rests


def with_statics(limb: Limb, gains: Array, rests: Array) -> Limb:
    """Return the limb with these gains (M,) [rad/Pa] and rest angles (M,) [rad].

    Statics tell gain over stiffness alone: the stiffness of the prior is kept.
    """
    segments = tuple(
        replace(
            segment,
            moment_gain=float(gain) * segment.bending_stiffness / segment.length,
            rest_curvature=float(rest) / segment.length,
        )
        for segment, gain, rest in zip(limb.segments, gains, rests, strict=True)
    )
    return replace(limb, segments=segments)
