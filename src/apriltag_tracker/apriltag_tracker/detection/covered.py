"""Dark shapes on white with a corner covered: four long sides that meet outside of what is seen."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

_WINDOW = 23
_FEWEST, _MOST = 5, 12
"""Sides of the outline of a square with something over one of its corners."""

_FAR = 0.9
"""A corner lies at most so far from the outline, in lengths of the shortest long side."""


def covered_quads(
    image: NDArray[np.uint8],
    smallest: float,
    faint: bool,
    known: Sequence[NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Find quadrilaterals of which a corner cannot be seen.

    Args:
        image: grey image.
        smallest: shortest side [px].
        faint: whether to look for shapes of little contrast.
        known: corners (4, 2) px of what was found, which is left out.

    Returns:
        Corners (n, 4, 2) px, where the four longest sides meet, counter-clockwise as printed.
    """
    black = cv2.adaptiveThreshold(
        image,
        255,
        cv2.ADAPTIVE_THRESH_MEAN_C,
        cv2.THRESH_BINARY_INV,
        _WINDOW,
        3.0 if faint else 7.0,
    )
    outlines, _ = cv2.findContours(black, cv2.RETR_LIST, cv2.CHAIN_APPROX_SIMPLE)
    middles = np.array([corners.mean(axis=0) for corners in known]).reshape(-1, 2)
    quads = []
    for outline in outlines:
        if len(outline) < _FEWEST:
            continue
        x, y, wide, high = cv2.boundingRect(outline)
        if min(wide, high) < 0.8 * smallest or max(wide, high) > 0.5 * max(image.shape):
            continue
        if len(middles) and np.any(
            (np.abs(middles[:, 0] - x - 0.5 * wide) < 0.3 * wide)
            & (np.abs(middles[:, 1] - y - 0.5 * high) < 0.3 * high)
        ):
            continue
        quad = _four_sides(outline, smallest)
        if quad is not None:
            quads.append(quad)
    return np.array(quads).reshape(-1, 4, 2)


def _four_sides(outline: NDArray[np.int32], smallest: float) -> NDArray[np.float64] | None:
    """Return where the four longest sides of an outline meet, None if they are no quadrilateral."""
    length = cv2.arcLength(outline, True)
    area = cv2.contourArea(outline)
    # Not filled for more than half: noise, not the border of a tag.
    if area < 0.5 * smallest * smallest or area < 0.03 * length * length:
        return None
    shape = cv2.approxPolyDP(outline, 0.02 * length, True).reshape(-1, 2).astype(np.float64)
    if not _FEWEST <= len(shape) <= _MOST:
        return None
    sides = np.roll(shape, -1, axis=0) - shape
    lengths = np.hypot(sides[:, 0], sides[:, 1])
    longest = np.sort(np.argsort(lengths)[-4:])
    shortest = float(lengths[longest].min())
    if shortest < 0.4 * smallest:
        return None
    corners = np.empty((4, 2))
    for k in range(4):
        a, b = longest[k - 1], longest[k]
        across = sides[a, 0] * sides[b, 1] - sides[a, 1] * sides[b, 0]
        if abs(across) < 0.3 * lengths[a] * lengths[b]:
            return None
        gap = shape[b] - shape[a]
        corners[k] = shape[a] + (gap[0] * sides[b, 1] - gap[1] * sides[b, 0]) / across * sides[a]
    away = np.abs(corners[:, None] - shape[None]).sum(axis=2).min(axis=1)
    if away.max() > _FAR * shortest:
        return None
    # An outline runs clockwise or not: as printed is counter-clockwise, with y down.
    along, other = corners[2] - corners[0], corners[3] - corners[1]
    if along[0] * other[1] - along[1] * other[0] > 0.0:
        corners = corners[::-1].copy()
    return corners
