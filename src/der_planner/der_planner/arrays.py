"""The one type of array in signatures, its shape in the docstring; lines, distances and points."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = NDArray[np.floating[Any]] | NDArray[np.integer[Any]]


def interpolate(instants: Numbers, time: Numbers, values: Array) -> Array:
    """Return the values (I, M) at instants (I,), on straight lines between samples.

    Args:
        instants: where values are wanted [s]; beyond the samples the outermost one holds.
        time: (K,) rising instants of the samples [s].
        values: (K, M) samples.
    """
    return np.stack([np.interp(instants, time, column) for column in values.T], axis=1)


def rms_distance(difference: Array) -> float:
    """Return the root mean square of the lengths of K vectors (K, N)."""
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))


def points_of(points: Iterable[Any]) -> Array:
    """Return the points of a message as (P, 2) [m]."""
    return np.array([(point.x, point.y) for point in points]).reshape(-1, 2)
