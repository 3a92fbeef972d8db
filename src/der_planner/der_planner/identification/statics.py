"""Start values in closed form: gain, rest angle and, under gravity, stiffness from a whole log."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.logs.log import LogError
from der_planner.limb import Limb
from der_planner.model.material import Material

Array = NDArray[np.float64]

LEAST_EXCITATION = 1000.0
"""Standard deviation of an input below which its gain cannot be told [Pa]."""
LEAST_ROWS = 3
COMPLIANCE_SPREAD = 0.3
"""Relative standard deviation of the prior's compliance, against `ERROR` of an even bend."""
ERROR = np.deg2rad(5.0)
LARGEST_CHANGE = 0.6
"""Of the logarithm of the stiffness: a start, not a result."""


class StaticStart(NamedTuple):
    """Where a fit begins.

    Attributes:
        gain: (M,) bend angle per differential pressure [rad/Pa].
        rest: (M,) bend angle without pressure and weight [rad].
        log_stiffness: (M,) logarithm of the stiffness over the prior's.
    """

    gain: Array
    rest: Array
    log_stiffness: Array


def static_start(limb: Limb, pressure: Array, bend: Array) -> StaticStart:
    """Fit bend = gain · pressure + compliance · (torque of the weight) + rest to each segment.

    The weight's torque is that of evenly bent segments at the measured bend angles. Without gravity
    it is zero, and the compliance stays the prior's.

    Args:
        limb: the prior, with its gravity and masses.
        pressure: (S, M) [Pa].
        bend: (S, M) measured bend angles [rad].

    Raises:
        LogError: too few rows, or an input that was not excited.
    """
    if len(pressure) < LEAST_ROWS:
        raise LogError(f"only {len(pressure)} rows of the log can be used: record a whole run")
    weight = Material(limb).weight_torques(bend)
    columns = []
    for index, segment in enumerate(limb.segments):
        spread = float(np.std(pressure[:, index]))
        if spread < LEAST_EXCITATION:
            raise LogError(
                f"input {index} was not excited (standard deviation {spread:.0f} Pa): its gain "
                "cannot be told"
            )
        known = segment.length / segment.bending_stiffness
        # The last row is what is known of the compliance, as one more measurement.
        design = np.stack(
            [pressure[:, index] / spread, known * weight[:, index], np.ones(len(pressure))], axis=1
        )
        doubt = ERROR / COMPLIANCE_SPREAD
        design = np.concatenate([design, [[0.0, doubt * np.sqrt(len(bend)), 0.0]]])
        seen = np.append(bend[:, index], doubt * np.sqrt(len(bend)))
        gain, compliance, rest = np.linalg.lstsq(design, seen, rcond=None)[0]
        change = -np.log(max(compliance, 1e-3))
        columns.append((gain / spread, rest, np.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE)))
    return StaticStart(*np.array(columns).T)
