"""Read the code of a tag whose corners are known.

Cells are sampled at their centres, sharpened against their neighbours, and compared with a
threshold half-way between two planes: one through the white margin, one through the black border,
so that uneven light does not matter. A family with a white border is read in the negative.
"""

from __future__ import annotations

import functools

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.detection.edges import inside, sample
from apriltag_tracker.family import Family, Layout

SHARPENING = 0.25
"""Share of the difference between a cell and its neighbours that is added to it."""

UNREADABLE = 64

_LEAST_CONTRAST = 12.0


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


@njit(cache=True)  # type: ignore[untyped-decorator]
def square_to_quad(c: NDArray[np.float64]) -> NDArray[np.float64]:
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


@njit(cache=True)  # type: ignore[untyped-decorator]
def _sample_cells(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    rim: int,
    values: NDArray[np.float64],
) -> bool:
    """Sample the n x n cells of a tag, `rim` of them outside of its border; row 0 is the upper."""
    h = square_to_quad(corners)
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


@njit(cache=True)  # type: ignore[untyped-decorator]
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


@njit(cache=True)  # type: ignore[untyped-decorator]
def _sharpened(values: NDArray[np.float64], row: int, column: int) -> float:
    """Return a cell with more of its difference from its four neighbours; the last have fewer."""
    last = len(values) - 1
    value = values[row, column]
    neighbours = values[max(row - 1, 0), column] + values[min(row + 1, last), column]
    neighbours += values[row, max(column - 1, 0)] + values[row, min(column + 1, last)]
    return float(value + SHARPENING * (4.0 * value - neighbours))


@njit(cache=True)  # type: ignore[untyped-decorator]
def read_code(
    image: NDArray[np.uint8], corners: NDArray[np.float64], layout: Layout
) -> tuple[bool, np.uint64]:
    """Read the cells of one tag's code as an integer, upper left cell first.

    Args:
        image: grey image.
        corners: (4, 2) px, counter-clockwise as printed; the first is taken for the lower left.
        layout: of the family.

    Returns:
        Whether there is a tag (white margin, black border, contrast), and the code.
    """
    code_cells, outer = layout
    grid = code_cells + 4 + 2 * outer
    middle = 0.5 * (grid - 1)
    values = np.empty((grid, grid))
    code = np.uint64(0)
    if not _sample_cells(image, corners, 1 + outer, values):
        return False, code
    white, white_row, white_column = _ring_plane(values, outer)
    black, black_row, black_column = _ring_plane(values, outer + 1)
    if white - black < _LEAST_CONTRAST:
        return False, code
    mean = 0.5 * (white + black)
    slope_row, slope_column = 0.5 * (white_row + black_row), 0.5 * (white_column + black_column)
    wrong = 0
    for row in range(grid):
        for column in range(grid):
            ring = min(row, column, grid - 1 - row, grid - 1 - column)
            threshold = mean + slope_row * (row - middle) + slope_column * (column - middle)
            if ring == outer + 1:
                wrong += values[row, column] > threshold
            elif ring != outer:
                bright = _sharpened(values, row, column) > threshold
                code = (code << np.uint64(1)) | np.uint64(bright)
    # One cell of 14 of the border may be wrong.
    return wrong <= 4 * (code_cells + 1) // 14, code


@njit(cache=True)  # type: ignore[untyped-decorator]
def count_bits(value: np.uint64) -> np.int64:
    """Count the ones of an integer: in pairs of bits, in fours, in bytes, and these added up."""
    value -= (value >> np.uint64(1)) & np.uint64(0x5555555555555555)
    fours = np.uint64(0x3333333333333333)
    value = (value & fours) + ((value >> np.uint64(2)) & fours)
    value = (value + (value >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return np.int64((value * np.uint64(0x0101010101010101)) >> np.uint64(56))


@njit(cache=True)  # type: ignore[untyped-decorator]
def distances(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    layout: Layout,
    expected: NDArray[np.uint64],
    found: NDArray[np.bool_],
    distance: NDArray[np.int64],
) -> None:
    """Count the cells in which quadrilaterals (n, 4, 2) differ from the codes (n,) expected there.

    Where `found` is false or nothing can be read the distance is `UNREADABLE`.
    """
    for i in range(corners.shape[0]):
        distance[i] = UNREADABLE
        if not found[i]:
            continue
        readable, code = read_code(image, corners[i], layout)
        if readable:
            distance[i] = count_bits(code ^ expected[i])


@njit(cache=True)  # type: ignore[untyped-decorator]
def identify(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    layout: Layout,
    table: NDArray[np.uint64],
    found: NDArray[np.bool_],
    ids: NDArray[np.int64],
    turns: NDArray[np.int64],
    distance: NDArray[np.int64],
) -> None:
    """Find the tag whose code is nearest to what quadrilaterals (n, 4, 2) show, in any direction.

    Args:
        image: grey image.
        corners: (n, 4, 2) px, counter-clockwise as printed, starting anywhere.
        layout: of the family.
        table: of `code_table`.
        found: (n,) which to read.
        ids: (n,) output.
        turns: (n,) output: which corner is the printed lower left.
        distance: (n,) output: wrong cells; `UNREADABLE` where there is no tag.
    """
    for i in range(corners.shape[0]):
        distance[i] = UNREADABLE
        if not found[i]:
            continue
        readable, code = read_code(image, corners[i], layout)
        if readable:
            ids[i], turns[i], distance[i] = _nearest(code, table)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _nearest(code: np.uint64, table: NDArray[np.uint64]) -> tuple[int, int, int]:
    """Return the tag nearest to a code, which corner is its lower left, and the wrong cells."""
    nearest, corner, distance = 0, 0, UNREADABLE
    for turn in range(4):
        for tag in range(table.shape[1]):
            wrong = count_bits(code ^ table[turn, tag])
            if wrong < distance:
                nearest, corner, distance = tag, (4 - turn) % 4, wrong
    return nearest, corner, distance


def nearest_code(cells: NDArray[np.bool_], family: Family) -> tuple[int, int, int]:
    """Find the tag nearest to cells (n,) that were read, white is true, from the upper left.

    Returns:
        The tag, which corner of the quadrilateral is its printed lower left, and the wrong cells.
    """
    weights = np.uint64(1) << np.arange(len(cells) - 1, -1, -1, dtype=np.uint64)
    tag, turn, wrong = _nearest((cells * weights).sum(dtype=np.uint64), code_table(family))
    return int(tag), int(turn), int(wrong)
