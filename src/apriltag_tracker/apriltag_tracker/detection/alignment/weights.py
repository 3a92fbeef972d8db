"""How much each pixel counts in a fit, from how well it fits."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

QUANTISATION = 0.3
"""Standard deviation of the rounding to whole grey levels."""

_BESIDE, _MOST_BESIDE = 2, 5
"""What covers a tag is blurred: pixels so near to what does not fit count no more either [px].
Where runs of pixels are left out, the nearest one that shows what does not fit is further away."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def _typical(residual: NDArray[np.float64], count: int) -> float:
    """Return the residuals' standard deviation from the median of about 200 of them."""
    step = max(count // 200, 1)
    return max(1.4826 * float(np.median(np.abs(residual[:count:step]))), QUANTISATION)


@njit(cache=True)  # type: ignore[untyped-decorator]
def neighbours_alike(
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    where: NDArray[np.int64],
    count: int,
) -> float:
    """Return the correlation of the residuals of neighbouring pixels, 0 to 0.9.

    What the model lacks leaves residuals that are alike in neighbours. Of a sequence with this
    correlation ρ, n values are worth n (1 − ρ) / (1 + ρ); the same holds across the rows.
    """
    product, square = 0.0, 1e-12
    for i in range(count - 1):
        if where[0, i] == where[0, i + 1] and where[1, i] + 1 == where[1, i + 1]:
            both = weights[i] * weights[i + 1]
            product += both * residual[i] * residual[i + 1]
            square += 0.5 * both * (residual[i] ** 2 + residual[i + 1] ** 2)
    return min(max(product / square, 0.0), 0.9)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _weigh_beside(
    residual: NDArray[np.float64],
    limit: float,
    where: NDArray[np.int64],
    count: int,
    beside: int,
    weights: NDArray[np.float64],
) -> None:
    """Take the weight from the pixels `beside` those whose residual is above a limit."""
    top, left = where[0, 0], where[1, :count].min()
    marked = np.zeros(
        (where[0, count - 1] - top + 1, where[1, :count].max() - left + 1), dtype=np.bool_
    )
    for i in range(count):
        if abs(residual[i]) > limit:
            row, column = where[0, i] - top, where[1, i] - left
            marked[
                max(row - beside, 0) : row + beside + 1,
                max(column - beside, 0) : column + beside + 1,
            ] = True
    for i in range(count):
        if marked[where[0, i] - top, where[1, i] - left]:
            weights[i] = min(weights[i], 0.01)


@njit(cache=True)  # type: ignore[untyped-decorator]
def weigh(
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    where: NDArray[np.int64],
    count: int,
    share: float,
    stride: int,
) -> None:
    """Take weight from what is far off; the new weights count by a share.

    Something that covers a part of the tag is blurred, too: what is beside it counts less as well.
    """
    limit = 3.5 * _typical(residual, count)
    largest = 0.0
    for i in range(count):
        off = abs(residual[i])
        fresh = 1.0 if off <= limit else (limit / off) ** 4
        weights[i] += share * (fresh - weights[i])
        largest = max(largest, off)
    if largest > 2.0 * limit:
        beside = min(_BESIDE + stride - 1, _MOST_BESIDE)
        _weigh_beside(residual, 2.0 * limit, where, count, beside, weights)
