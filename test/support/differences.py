"""Derivatives by central differences, to compare others with."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def slopes(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    point: NDArray[np.float64],
    step: float = 1e-6,
) -> NDArray[np.float64]:
    """Return the derivatives (…, n) of a function by each number of a point (n,)."""
    moves = step * np.eye(len(point))
    ends = [(function(point + move), function(point - move)) for move in moves]
    return np.stack([(ahead - behind) / (2.0 * step) for ahead, behind in ends], axis=-1)
