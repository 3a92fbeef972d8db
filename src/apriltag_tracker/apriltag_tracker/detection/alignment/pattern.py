"""The printed pattern of a tag as a camera with a Gaussian blur sees it, tabulated on a grid.

The pattern is constant on cells, so that its convolution with a Gaussian is a product of
differences of the error function along columns and rows: V = A C Aᵀ with the cells C and A[i, c]
the share of cell c in grid point i. Derivatives by place and by blur are products of that kind.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

LAYERS = 4
"""Value, derivatives by column and by row (a cell), derivative by the blur (a cell)."""


class Pattern(NamedTuple):
    """The pattern of a tag under one blur.

    Attributes:
        table: of `tabulate`.
        blur: of the table [cells].
        border: cells along the border.
        rim: cells around the border that belong to the pattern.
    """

    table: NDArray[np.float32]
    blur: float
    border: float
    rim: float


_REACH = 4.0
_ROOT = math.sqrt(0.5)
_DENSITY = 1.0 / math.sqrt(2.0 * math.pi)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _shares(
    cells: int, resolution: int, blur: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return shares (points, cells), and their derivatives by the point and by the blur."""
    points = cells * resolution + 1
    share = np.zeros((points, cells))
    by_place = np.zeros((points, cells))
    by_blur = np.zeros((points, cells))
    for i in range(points):
        x = i / resolution
        for c in range(cells):
            # The outer cells go on for ever: what lies beyond the sheet is not modelled.
            low = -_REACH * 2.0 if c == 0 else (c - x) / blur
            high = _REACH * 2.0 if c == cells - 1 else (c + 1 - x) / blur
            if low > _REACH or high < -_REACH:
                continue
            share[i, c] = 0.5 * (math.erf(high * _ROOT) - math.erf(low * _ROOT))
            at_low = _DENSITY * math.exp(-0.5 * low * low)
            at_high = _DENSITY * math.exp(-0.5 * high * high)
            by_place[i, c] = (at_low - at_high) / blur
            by_blur[i, c] = (low * at_low - high * at_high) / blur
    return share, by_place, by_blur


@njit(cache=True)  # type: ignore[untyped-decorator]
def tabulate(cells: NDArray[np.uint8], resolution: int, blur: float) -> NDArray[np.float32]:
    """Tabulate a blurred pattern.

    Args:
        cells: (n, n) cells of the tag with its rim, 1 is white, upper row first.
        resolution: grid points a cell.
        blur: standard deviation of the Gaussian [cells].

    Returns:
        (n resolution + 1, n resolution + 1, 4): row, column, and the layers of `LAYERS`.
    """
    count = cells.shape[0]
    share, by_place, by_blur = _shares(count, resolution, blur)
    points = share.shape[0]
    plain = np.zeros((points, count))
    moved = np.zeros((points, count))
    wider = np.zeros((points, count))
    for i in range(points):
        for k in range(count):
            if share[i, k] == 0.0 and by_place[i, k] == 0.0:
                continue
            for c in range(count):
                if cells[k, c]:
                    plain[i, c] += share[i, k]
                    moved[i, c] += by_place[i, k]
                    wider[i, c] += by_blur[i, k]
    table = np.zeros((points, points, LAYERS), dtype=np.float32)
    for j in range(points):
        first, last = count, 0
        for c in range(count):
            if share[j, c] != 0.0 or by_place[j, c] != 0.0:
                first, last = min(first, c), max(last, c)
        for i in range(points):
            value, column, row, blurred = 0.0, 0.0, 0.0, 0.0
            for c in range(first, last + 1):
                value += plain[i, c] * share[j, c]
                column += plain[i, c] * by_place[j, c]
                row += moved[i, c] * share[j, c]
                blurred += plain[i, c] * by_blur[j, c] + wider[i, c] * share[j, c]
            table[i, j, 0] = value
            table[i, j, 1] = column
            table[i, j, 2] = row
            table[i, j, 3] = blurred
    return table
