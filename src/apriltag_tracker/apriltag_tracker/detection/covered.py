"""Dark shapes on white whose outline has four straight sides, whatever lies between the sides.

A square with a corner covered has an outline that runs around what covers it; of one that is
smeared over the white around it, the outline has gaps and dents. Both still have four straight
sides, and where these meet are the corners.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

_WINDOW = 11
"""In which the mean is taken, in steps of two pixels."""

_DARKER = 3.0
"""Black is darker than the mean by so much [grey levels]; noise is smoothed first."""

_OFF_THE_LINE, _OFF_THE_SHEET = 1.3, 2.2
"""How far an outline may be from a straight side of the border, or of the sheet [px]."""

_MOST_SIDES, _MOST_NEXT, _MOST_QUADS = 400, 16, 40
"""Of an outline: sides that are tried, sides that may follow on one, quadrilaterals."""

_LEAST_SHARE, _LEAST_COVERAGE = 0.3, 0.54
"""How much of each side, and of all four, the outline must follow."""

_OUTWARD = 1.0
"""An outline goes through the middles of the last black pixels, and black is what is darker than
half-way: corners lie outside of it by so much along the diagonals [px], those of a sheet inside."""

_SHEET = 0.8
"""Size of the black border over that of the white sheet around it."""

_STRAIGHT = 0.35
"""Sine of the least angle between neighbouring sides."""


def covered_quads(
    image: NDArray[np.uint8], smallest: float, known: Sequence[NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Find quadrilaterals whose outline is not closed, or runs around something else as well.

    Args:
        image: grey image.
        smallest: shortest side [px].
        known: corners (4, 2) px of what was found, which is left out.

    Returns:
        Corners (n, 4, 2) px, counter-clockwise as printed.
    """
    black = _darker_than_around(image)
    for corners in known:
        # A closed outline may still touch its neighbour's: what is known is taken out of both.
        cv2.fillConvexPoly(black, np.round(corners).astype(np.int32), 0)
    found = _of_mask(black, smallest)
    # Where white cells were smeared over the border, its parts are put together again.
    whole = cv2.morphologyEx(black, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    found += _of_mask(whole, smallest)
    # Of tags that are smeared to pieces the white sheet still has four sides.
    sheets = _of_mask(whole, smallest / _SHEET, white=True)
    inner = [quad.mean(axis=0) + _SHEET * (quad - quad.mean(axis=0)) for quad in sheets]
    return np.concatenate([_moved(found, _OUTWARD), _moved(inner, -_SHEET * _OUTWARD)])


def _moved(quads: Sequence[NDArray[np.float64]], outward: float) -> NDArray[np.float64]:
    """Return quadrilaterals (n, 4, 2) with the corners moved along the diagonals [px]."""
    result = np.array(quads).reshape(-1, 4, 2)
    diagonals = result - np.roll(result, 2, axis=1)
    result += outward * diagonals / np.linalg.norm(diagonals, axis=2, keepdims=True)
    return result


def _darker_than_around(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return where an image without its noise is darker than the mean around; 255 is dark."""
    rows, columns = image.shape
    smooth = cv2.GaussianBlur(image, (5, 5), 0.0)
    # The mean changes slowly: half the resolution is enough.
    half = cv2.resize(
        image, (max(columns // 2, 1), max(rows // 2, 1)), interpolation=cv2.INTER_AREA
    )
    around = cv2.resize(cv2.blur(half, (_WINDOW, _WINDOW)), (columns, rows))
    result: NDArray[np.uint8] = cv2.compare(cv2.add(smooth, _DARKER), around, cv2.CMP_LT)
    return result


def _of_mask(
    black: NDArray[np.uint8], smallest: float, white: bool = False
) -> list[NDArray[np.float64]]:
    """Return the quadrilaterals (4, 2) px that outlines in a mask make, of what is black or not."""
    outlines, _ = cv2.findContours(black, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    quads = np.empty((_MOST_QUADS, 4, 2))
    found: list[NDArray[np.float64]] = []
    for outline in outlines:
        if len(outline) < 6:
            continue
        _, _, wide, high = cv2.boundingRect(outline)
        if min(wide, high) < 0.8 * smallest:
            continue
        off = _OFF_THE_SHEET if white else _OFF_THE_LINE
        shape = cv2.approxPolyDP(outline, off, True).reshape(-1, 2).astype(np.float64)
        if white:
            shape = shape[::-1].copy()
        if len(shape) >= 4:
            found += [quads[k].copy() for k in range(_four_sides(shape, smallest, quads))]
    return found


@njit(cache=True)  # type: ignore[untyped-decorator]
def _long_sides(
    shape: NDArray[np.float64], least: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return starts, vectors and lengths of a polygon's sides that are long enough."""
    sides = np.empty_like(shape)
    lengths = np.empty(len(shape))
    for i in range(len(shape)):
        sides[i] = shape[(i + 1) % len(shape)] - shape[i]
        lengths[i] = np.hypot(sides[i, 0], sides[i, 1])
    order = np.argsort(-lengths)[:_MOST_SIDES]
    order = np.sort(order[lengths[order] >= least])
    return shape[order], sides[order], lengths[order]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _followers(
    starts: NDArray[np.float64], sides: NDArray[np.float64], lengths: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return for each side those that may follow on it round a corner, and how many."""
    count = len(starts)
    after, many = np.empty((count, _MOST_NEXT), dtype=np.int64), np.zeros(count, dtype=np.int64)
    # A side of which a part is seen goes on beyond it by so many of its lengths.
    beyond = 1.0 / _LEAST_SHARE
    for a in range(count):
        # The next ones along the outline first.
        for step in range(1, count):
            b = (a + step) % count
            across = sides[a, 0] * sides[b, 1] - sides[a, 1] * sides[b, 0]
            # Outlines run so that what is black is on this side of them.
            if -across < _STRAIGHT * lengths[a] * lengths[b] or many[a] == _MOST_NEXT:
                continue
            x, y = starts[b, 0] - starts[a, 0], starts[b, 1] - starts[a, 1]
            reach = (x * sides[b, 1] - y * sides[b, 0]) / across
            back = (x * sides[a, 1] - y * sides[a, 0]) / across
            if 0.7 < reach < beyond and 1.0 - beyond < back < 0.3:
                after[a, many[a]] = b
                many[a] += 1
    return after, many


@njit(cache=True)  # type: ignore[untyped-decorator]
def _meet(
    starts: NDArray[np.float64],
    sides: NDArray[np.float64],
    lengths: NDArray[np.float64],
    picked: NDArray[np.int64],
    corners: NDArray[np.float64],
) -> bool:
    """Write where four sides meet, the first with the last first; False if they turn back."""
    for k in range(4):
        a, b = picked[k - 1], picked[k]
        across = sides[a, 0] * sides[b, 1] - sides[a, 1] * sides[b, 0]
        if -across < _STRAIGHT * lengths[a] * lengths[b]:
            return False
        gap_x, gap_y = starts[b, 0] - starts[a, 0], starts[b, 1] - starts[a, 1]
        reach = (gap_x * sides[b, 1] - gap_y * sides[b, 0]) / across
        corners[k, 0] = starts[a, 0] + reach * sides[a, 0]
        corners[k, 1] = starts[a, 1] + reach * sides[a, 1]
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]
def _coverage(
    starts: NDArray[np.float64],
    sides: NDArray[np.float64],
    lengths: NDArray[np.float64],
    picked: NDArray[np.int64],
    corners: NDArray[np.float64],
    smallest: float,
) -> float:
    """Return the share of a quadrilateral's perimeter that the sides follow, 0 of an odd one."""
    shortest, longest, perimeter, followed = 1e9, 0.0, 0.0, 0.0
    for k in range(4):
        start, end, side = corners[k], corners[(k + 1) % 4], picked[k]
        x, y = end[0] - start[0], end[1] - start[1]
        length = np.hypot(x, y)
        shortest, longest = min(shortest, length), max(longest, length)
        if shortest < 0.8 * smallest or longest > 2.5 * shortest:
            return 0.0
        # From corner to corner the side must run as the outline does, and within them.
        low = ((starts[side, 0] - start[0]) * x + (starts[side, 1] - start[1]) * y) / length
        high = low + (sides[side, 0] * x + sides[side, 1] * y) / length
        slack = 0.1 * length + 2.0
        if high < low or low < -slack or high > length + slack:
            return 0.0
        part = min(lengths[side], length)
        if part < _LEAST_SHARE * length:
            return 0.0
        perimeter += length
        followed += part
    return followed / perimeter


@njit(cache=True)  # type: ignore[untyped-decorator]
def _keep(
    corners: NDArray[np.float64],
    share: float,
    quads: NDArray[np.float64],
    shares: NDArray[np.float64],
    count: int,
) -> int:
    """Add a quadrilateral to those found; of two at one place the better covered one stays."""
    x, y = corners[:, 0].mean(), corners[:, 1].mean()
    near = 0.3 * np.hypot(corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1])
    for k in range(count):
        if np.hypot(quads[k, :, 0].mean() - x, quads[k, :, 1].mean() - y) < near:
            if share > shares[k]:
                quads[k], shares[k] = corners, share
            return count
    if count == len(quads):
        return count
    quads[count], shares[count] = corners, share
    return count + 1


@njit(cache=True)  # type: ignore[untyped-decorator]
def _four_sides(shape: NDArray[np.float64], smallest: float, quads: NDArray[np.float64]) -> int:
    """Find the quadrilaterals that four sides of a polygon make; returns how many.

    Args:
        shape: (n, 2) px, a polygon.
        smallest: shortest side [px].
        quads: (m, 4, 2) px, output, counter-clockwise as printed.
    """
    starts, sides, lengths = _long_sides(shape, _LEAST_SHARE * 0.8 * smallest)
    after, many = _followers(starts, sides, lengths)
    shares = np.zeros(len(quads))
    corners, picked = np.empty((4, 2)), np.empty(4, dtype=np.int64)
    count = 0
    for a in range(len(starts)):
        for b in after[a, : many[a]]:
            for c in after[b, : many[b]]:
                for d in after[c, : many[c]]:
                    # Each ring of four is met from each of its sides: the first one counts.
                    if a > b or a > c or a > d or not np.any(after[d, : many[d]] == a):
                        continue
                    picked[0], picked[1], picked[2], picked[3] = a, b, c, d
                    if not _meet(starts, sides, lengths, picked, corners):
                        continue
                    share = _coverage(starts, sides, lengths, picked, corners, smallest)
                    if share >= _LEAST_COVERAGE:
                        count = _keep(corners, share, quads, shares, count)
    return count
