"""Read the code of a tag whose corners are known.

Cells are sampled at their centres, sharpened against their neighbours, and compared with a
threshold half-way between two planes: one through the white margin, one through the black border,
so that uneven light does not matter. A family with a white border is read in the negative.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.detection.edges import inside, sample
from apriltag_tracker.family import Family, Layout

_SHARPENING = 0.25
"""This share of the difference between a cell and its neighbours is added to the cell."""

_LEAST_CONTRAST = 12.0
"""A tag whose margin is not brighter than its border by this is none [grey levels]."""

UNREADABLE = math.inf
"""The misfit of a quadrilateral that shows no tag."""


@functools.cache
def code_table(family: Family) -> NDArray[np.uint64]:
    """Return the codes of all printed tags in four directions as integers, (4, tags).

    Row r holds what is read when the corners start r corners late: at the printed lower right for
    r = 1, and so on counter-clockwise.
    """
    mask, codes = family.code_mask(), family.codes()
    bits = codes.shape[1]
    weights = np.uint64(1) << np.arange(bits - 1, -1, -1, dtype=np.uint64)
    cells = np.zeros((len(codes), *mask.shape), dtype=np.uint8)
    cells[:, mask] = 1 - codes if family.outer_ring else codes
    rows = [
        (np.rot90(cells, -turn, axes=(1, 2))[:, mask] * weights).sum(axis=1, dtype=np.uint64)
        for turn in range(4)
    ]
    return np.ascontiguousarray(rows)


def nearest_tag(code: np.uint64, family: Family) -> tuple[int, int, int]:
    """Return the tag nearest to a code, which corner is its printed lower left, and wrong cells."""
    wrong = np.bitwise_count(code_table(family) ^ code)
    turn, tag = divmod(int(np.argmin(wrong)), wrong.shape[1])
    return tag, (4 - turn) % 4, int(wrong[turn, tag])


@njit(cache=True)
def _square_to_quad(c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the projective map of the unit square onto a quadrilateral (Heckbert 1989)."""
    dx1, dx2 = c[1, 0] - c[2, 0], c[3, 0] - c[2, 0]
    dy1, dy2 = c[1, 1] - c[2, 1], c[3, 1] - c[2, 1]
    sx = c[0, 0] - c[1, 0] + c[2, 0] - c[3, 0]
    sy = c[0, 1] - c[1, 1] + c[2, 1] - c[3, 1]
    determinant = dx1 * dy2 - dx2 * dy1
    g = (sx * dy2 - dx2 * sy) / determinant
    h = (dx1 * sy - sx * dy1) / determinant
    out = np.empty(8)
    out[0] = c[1, 0] - c[0, 0] + g * c[1, 0]
    out[1] = c[3, 0] - c[0, 0] + h * c[3, 0]
    out[2] = c[0, 0]
    out[3] = c[1, 1] - c[0, 1] + g * c[1, 1]
    out[4] = c[3, 1] - c[0, 1] + h * c[3, 1]
    out[5] = c[0, 1]
    out[6] = g
    out[7] = h
    return out


@njit(cache=True)
def _sample_cells(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    rim: int,
    values: NDArray[np.float64],
) -> bool:
    """Sample the n x n cells of a tag, `rim` of them outside of its border; row 0 is the upper."""
    h = _square_to_quad(corners)
    grid = len(values)
    border = grid - 2.0 * rim
    for row in range(grid):
        v = 1.0 - (row + 0.5 - rim) / border
        for column in range(grid):
            u = (column + 0.5 - rim) / border
            w = h[6] * u + h[7] * v + 1.0
            x = (h[0] * u + h[1] * v + h[2]) / w
            y = (h[3] * u + h[4] * v + h[5]) / w
            if not inside(image, x, y):
                return False
            values[row, column] = sample(image, x, y)
    return True


@njit(cache=True)
def _ring_plane(values: NDArray[np.float64], ring: int) -> tuple[float, float, float]:
    """Return mean and slopes a row and a column of one ring of cells around the middle."""
    last = len(values) - 1 - ring
    total, along_row, along_column, weight, count = 0.0, 0.0, 0.0, 0.0, 0.0
    middle = 0.5 * (len(values) - 1)
    for row in range(ring, last + 1):
        for column in range(ring, last + 1):
            if row not in {ring, last} and column not in {ring, last}:
                continue
            value = values[row, column]
            total += value
            along_row += (row - middle) * value
            along_column += (column - middle) * value
            weight += (row - middle) ** 2
            count += 1.0
    return total / count, along_row / weight, along_column / weight


@njit(cache=True)
def _sharpened(values: NDArray[np.float64], row: int, column: int) -> float:
    """Return a cell with more of its difference from its four neighbours; the last have fewer."""
    last = len(values) - 1
    value = values[row, column]
    neighbours = values[max(row - 1, 0), column] + values[min(row + 1, last), column]
    neighbours += values[row, max(column - 1, 0)] + values[row, min(column + 1, last)]
    return float(value + _SHARPENING * (4.0 * value - neighbours))


@njit(cache=True)
def _read_code(
    image: NDArray[np.uint8], corners: NDArray[np.float64], layout: Layout
) -> tuple[float, np.uint64]:
    """Return misfit and code of one quadrilateral, see `read_codes`."""
    code_cells, outer = layout
    grid = code_cells + 4 + 2 * outer
    middle = 0.5 * (grid - 1)
    values = np.empty((grid, grid))
    code = np.uint64(0)
    if not _sample_cells(image, corners, 1 + outer, values):
        return UNREADABLE, code
    white, white_row, white_column = _ring_plane(values, outer)
    black, black_row, black_column = _ring_plane(values, outer + 1)
    if white - black < _LEAST_CONTRAST:
        return UNREADABLE, code
    mean, half = 0.5 * (white + black), 0.5 * (white - black)
    slope_row, slope_column = 0.5 * (white_row + black_row), 0.5 * (white_column + black_column)
    wrong, square = 0, 0.0
    for row in range(grid):
        for column in range(grid):
            ring = min(row, column, grid - 1 - row, grid - 1 - column)
            threshold = mean + slope_row * (row - middle) + slope_column * (column - middle)
            square += (abs(values[row, column] - threshold) / half - 1.0) ** 2
            if ring == outer + 1:
                wrong += values[row, column] > threshold
            elif ring != outer:
                bright = _sharpened(values, row, column) > threshold
                code = (code << np.uint64(1)) | np.uint64(bright)
    # One cell of 14 of the border may be wrong.
    if wrong > 4 * (code_cells + 1) // 14:
        return UNREADABLE, code
    return math.sqrt(square / grid**2), code


@njit(cache=True)
def read_codes(
    image: NDArray[np.uint8], corners: NDArray[np.float64], layout: Layout
) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
    """Read the cells of codes as integers, upper left cell first.

    Args:
        image: grey image.
        corners: (n, 4, 2) px, counter-clockwise as printed; the first is taken for the lower left.
        layout: of the family.

    Returns:
        The misfit (n,): RMS distance of the cells from plain black and white, in half contrasts;
        `UNREADABLE` without a white margin, a black border and contrast. And the codes (n,).
    """
    count = corners.shape[0]
    misfits, codes = np.empty(count), np.empty(count, dtype=np.uint64)
    for i in range(count):
        misfits[i], codes[i] = _read_code(image, corners[i], layout)
    return misfits, codes
