"""Series of numbers in time: the control period, and straight lines between samples."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array

Numbers = NDArray[np.floating[Any]] | NDArray[np.integer[Any]]

CONTROL_PERIOD = 0.05
"""A command is held for this long [s]: setpoints are 50 ms apart."""


def interpolate(instants: Numbers, time: Numbers, values: Array) -> Array:
    """Return the values (I, M) at instants (I,), on straight lines between samples.

    Args:
        instants: where values are wanted [s]; beyond the samples the outermost one holds.
        time: (K,) rising instants of the samples [s].
        values: (K, M) samples.
    """
    return np.stack([np.interp(instants, time, column) for column in values.T], axis=1)


def step_middles(count: int, steps: int, period: float = CONTROL_PERIOD) -> Array:
    """Return the middles (count · steps,) of equal steps in ``count`` periods from 0 on [s]."""
    return (np.arange(count * steps, dtype=np.float64) + 0.5) * (period / steps)
