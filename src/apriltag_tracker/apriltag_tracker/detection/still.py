"""A cheap look at whether a tag that does not move is where it was.

A few pixels across the four sides of the border tell by how much each side has moved, to a few
hundredths of a pixel, in some microseconds. That is enough to say that nothing has happened; who
wants the corners fits the pattern.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.detection.edges import inside, sample

SIDES = 4
_PLACES = 8
"""Along a side."""

_SLOPE_REACH = 0.5
"""The slope of the edge is taken between points so far to both sides of it [px]."""

_SHIFTED = 0.2
"""A side that went further has moved [px]."""

_DIMMED = 0.3
"""A contrast that changed by a larger share is another one: something covers the side."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def _look_at_side(
    image: NDArray[np.uint8],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    middle: NDArray[np.float64],
    cells: int,
    look: NDArray[np.float64],
) -> bool:
    """Write how far outside of a side its edge is [px], and the contrast [grey levels], (2,)."""
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    out_x, out_y = (end[1] - start[1]) / length, -(end[0] - start[0]) / length
    if out_x * (start[0] - middle[0]) + out_y * (start[1] - middle[1]) < 0.0:
        out_x, out_y = -out_x, -out_y
    deep = 0.5 * length / cells
    black, white, edge, slope = 0.0, 0.0, 0.0, 0.0
    for k in range(_PLACES):
        share = 0.1 + 0.8 * k / (_PLACES - 1)
        x, y = start[0] + share * (end[0] - start[0]), start[1] + share * (end[1] - start[1])
        if not (
            inside(image, x + deep * out_x, y + deep * out_y)
            and inside(image, x - deep * out_x, y - deep * out_y)
        ):
            return False
        white += sample(image, x + deep * out_x, y + deep * out_y)
        black += sample(image, x - deep * out_x, y - deep * out_y)
        edge += sample(image, x, y)
        slope += sample(image, x + _SLOPE_REACH * out_x, y + _SLOPE_REACH * out_y)
        slope -= sample(image, x - _SLOPE_REACH * out_x, y - _SLOPE_REACH * out_y)
    look[1] = (white - black) / _PLACES
    if slope <= 0.0:
        return False
    look[0] = (0.5 * (white + black) - edge) * 2.0 * _SLOPE_REACH / slope
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]
def look_at_borders(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    cells: int,
    looks: NDArray[np.float64],
) -> None:
    """Look at the borders of tags.

    Args:
        image: grey image.
        corners: (n, 4, 2) px, where the tags were.
        cells: along the border.
        looks: (n, 4, 2) output: of each side, how far outside of it the edge is [px] and the
            contrast [grey levels]; NaN where a side cannot be seen.
    """
    for i in range(corners.shape[0]):
        middle = np.array([corners[i, :, 0].mean(), corners[i, :, 1].mean()])
        for k in range(SIDES):
            if not _look_at_side(
                image, corners[i, k], corners[i, (k + 1) % SIDES], middle, cells, looks[i, k]
            ):
                looks[i, k] = np.nan


def unmoved(looks: NDArray[np.float64], before: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which tags look as they did before, (n,), from their looks (n, 4, 2); NaN never does."""
    shifted = np.abs(looks[:, :, 0] - before[:, :, 0])
    dimmed = np.abs(looks[:, :, 1] / before[:, :, 1] - 1.0)
    same: NDArray[np.bool_] = np.all((shifted < _SHIFTED) & (dimmed < _DIMMED), axis=1)
    return same
