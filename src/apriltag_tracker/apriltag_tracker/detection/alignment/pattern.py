"""The printed pattern of a tag as a camera with a Gaussian blur sees it, and its derivatives.

The pattern is constant on cells, so that its convolution with a Gaussian is a product of the
Gaussian's distribution along columns and rows: V = A C Aᵀ with the cells C and A[c] the share of
column or row c. Only edges between cells within a few standard deviations matter, one or two in
each direction: each adds the difference of the cells beside it times the distribution at the edge.
Derivatives by place and by blur are sums of that kind. Only the Gaussian is tabulated, so that
whatever the tag, the blur and the place, the same few kilobytes of memory are read.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

_REACH, _PER_SIGMA = 3.6, 40
"""Edges further away than so many standard deviations are not seen; points of the table in one."""

_HALF = round(_REACH * _PER_SIGMA)
_NEAR = 1.0 / _REACH
"""With a smaller blur [cells] only the edges of a place's own cell are within reach."""

EDGE_VALUES = 3
"""Of each edge: the share of what is before it, its derivatives by the place and by the blur."""


class Pattern(NamedTuple):
    """The pattern of a tag.

    Attributes:
        cells: (n, n) of `framed`.
        border: cells along the border.
        rim: cells around the border that belong to the pattern.
    """

    cells: NDArray[np.float64]
    border: float
    rim: float


def framed(cells: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return cells with one more around them like the outermost ones, which go on for ever."""
    return np.pad(cells.astype(np.float64), 1, mode="edge")


def _tabulate() -> NDArray[np.float64]:
    """Return the Gaussian's distribution and density, each with its step to the next, (n, 4)."""
    grid = np.arange(-_HALF, _HALF + 2) / _PER_SIGMA
    distribution = np.array([0.5 * (1.0 + math.erf(x * math.sqrt(0.5))) for x in grid.tolist()])
    density = np.exp(-0.5 * grid**2) / math.sqrt(2.0 * math.pi)
    # What is further away is not seen at all.
    distribution[0], distribution[-2:], density[0], density[-2:] = 0.0, 1.0, 0.0, 0.0
    steps = np.diff(distribution), np.diff(density)
    return np.column_stack([distribution[:-1], steps[0], density[:-1], steps[1]])


_GAUSSIAN = _tabulate()


@njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)  # type: ignore[untyped-decorator]
def _gaussian(t: float) -> tuple[float, float]:
    """Return the Gaussian's distribution and density at t standard deviations."""
    place = min(max(t * _PER_SIGMA + _HALF, 0.0), 2.0 * _HALF - 1e-9)
    whole = np.intp(place)
    part, k = place - whole, np.uintp(whole)
    return (
        _GAUSSIAN[k, 0] + part * _GAUSSIAN[k, 1],
        _GAUSSIAN[k, 2] + part * _GAUSSIAN[k, 3],
    )


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _edges(at: float, blur: float, count: int, edges: NDArray[np.float64]) -> tuple[int, int]:
    """Write what edges between cells do at a place of a row of cells.

    Args:
        at: the place [cells].
        blur: standard deviation [cells].
        count: of cells.
        edges: (n, 3) output from the first edge on, see `EDGE_VALUES`.

    Returns:
        The cell before the first edge within reach, and the cell after the last one.
    """
    first = max(math.ceil(at - _REACH * blur), 1)
    last = min(math.floor(at + _REACH * blur), count - 1)
    if first > last:
        alone = min(max(math.floor(at), 0), count - 1)
        return alone, alone
    inverse = 1.0 / blur
    for e in range(first, last + 1):
        t = (e - at) * inverse
        share, density = _gaussian(t)
        edges[e - first, 0] = share
        edges[e - first, 1] = -density * inverse
        edges[e - first, 2] = -density * inverse * t
    return first - 1, last


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _along_row(
    cells: NDArray[np.float64], row: int, left: int, right: int, edges: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Return one row of cells, blurred along itself, and its derivatives by column and blur."""
    value, by_column, by_blur = cells[row, right], 0.0, 0.0
    for c in range(left, right):
        step = cells[row, c] - cells[row, c + 1]
        value += step * edges[c - left, 0]
        by_column += step * edges[c - left, 1]
        by_blur += step * edges[c - left, 2]
    return value, by_column, by_blur


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _look_far(
    cells: NDArray[np.float64],
    blur: float,
    column: float,
    row: float,
    across: NDArray[np.float64],
    down: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """Return what `look_at` returns, from all edges within reach."""
    count = cells.shape[0]
    left, right = _edges(column, blur, count, across)
    top, bottom = _edges(row, blur, count, down)
    value, by_column, by_blur = _along_row(cells, bottom, left, right, across)
    by_row = 0.0
    after, after_by_column, after_by_blur = value, by_column, by_blur
    # From the last row upward: each edge adds what the row above it has more than the one below.
    for r in range(bottom - 1, top - 1, -1):
        above, above_by_column, above_by_blur = _along_row(cells, r, left, right, across)
        step, share = above - after, down[r - top, 0]
        value += step * share
        by_column += (above_by_column - after_by_column) * share
        by_row += step * down[r - top, 1]
        by_blur += (above_by_blur - after_by_blur) * share + step * down[r - top, 2]
        after, after_by_column, after_by_blur = above, above_by_column, above_by_blur
    return value, by_column, by_row, by_blur


@njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)  # type: ignore[untyped-decorator]
def _along_three(
    cells: NDArray[np.float64],
    row: int,
    before: int,
    shares: tuple[float, float],
    by_place: tuple[float, float],
    by_blur: tuple[float, float],
) -> tuple[float, float, float]:
    """Return what `_along_row` returns, of three cells with two edges between them."""
    own, last = cells[row, before + np.uintp(1)], cells[row, before + np.uintp(2)]
    step, other = cells[row, before] - own, own - last
    return (
        last + step * shares[0] + other * shares[1],
        step * by_place[0] + other * by_place[1],
        step * by_blur[0] + other * by_blur[1],
    )


@njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)  # type: ignore[untyped-decorator]
def _look_near(
    cells: NDArray[np.float64], blur: float, column: float, row: float
) -> tuple[float, float, float, float]:
    """Return what `look_at` returns, from the four edges of the place's own cell."""
    inverse = 1.0 / blur
    own_column, own_row = np.intp(column), np.intp(row)
    from_left, from_top = column - own_column, row - own_row
    c, r = np.uintp(own_column - 1), np.uintp(own_row - 1)
    t = -from_left * inverse, (1.0 - from_left) * inverse
    left, right = _gaussian(t[0]), _gaussian(t[1])
    shares, slopes = (left[0], right[0]), (left[1], right[1])
    turns = left[1] * t[0], right[1] * t[1]
    above = _along_three(cells, r, c, shares, slopes, turns)
    own = _along_three(cells, r + np.uintp(1), c, shares, slopes, turns)
    below = _along_three(cells, r + np.uintp(2), c, shares, slopes, turns)
    t = -from_top * inverse, (1.0 - from_top) * inverse
    top, bottom = _gaussian(t[0]), _gaussian(t[1])
    step, other = above[0] - own[0], own[0] - below[0]
    by_column = below[1] + (above[1] - own[1]) * top[0] + (own[1] - below[1]) * bottom[0]
    by_row = step * top[1] + other * bottom[1]
    by_blur = below[2] + (above[2] - own[2]) * top[0] + (own[2] - below[2]) * bottom[0]
    by_blur += step * top[1] * t[0] + other * bottom[1] * t[1]
    return (
        below[0] + step * top[0] + other * bottom[0],
        -by_column * inverse,
        -by_row * inverse,
        -by_blur * inverse,
    )


@njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)  # type: ignore[untyped-decorator]
def look_at(
    cells: NDArray[np.float64],
    blur: float,
    column: float,
    row: float,
    across: NDArray[np.float64],
    down: NDArray[np.float64],
) -> tuple[float, float, float, float]:
    """Return the blurred pattern at a place.

    Args:
        cells: (n, n) of the pattern.
        blur: standard deviation [cells].
        column: place from the left edge of these cells, at least 1 and less than n - 1.
        row: the same from their upper edge.
        across: (n, 3) room for the edges between columns.
        down: (n, 3) the same for rows.

    Returns:
        Value, 0 to 1, and its derivatives by column, row and blur [1/cell].
    """
    if blur < _NEAR:
        seen: tuple[float, float, float, float] = _look_near(cells, blur, column, row)
    else:
        seen = _look_far(cells, blur, column, row, across, down)
    return seen
