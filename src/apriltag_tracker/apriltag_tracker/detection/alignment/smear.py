"""What the residuals of a fit without a smear say about the smear that there is."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.detection.alignment.pattern import Pattern
from apriltag_tracker.detection.alignment.sampling import (
    Pixels,
    View,
    new_pixels,
    sample_model,
    side_length,
    straighten,
)
from apriltag_tracker.detection.decoding import square_to_quad

_LEAST_BLUR = 0.32
"""Of a pixel alone [px]."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def _write_terms(grid: NDArray[np.float64], y: int, x: int, row: NDArray[np.float64]) -> None:
    """Write half the second derivatives by x and y, the mixed one, 1, and the picture (5,)."""
    row[0] = 0.5 * (grid[y, x + 1] + grid[y, x - 1]) - grid[y, x]
    row[1] = 0.5 * (grid[y + 1, x] + grid[y - 1, x]) - grid[y, x]
    row[2] = 0.25 * (grid[y + 1, x + 1] + grid[y - 1, x - 1])
    row[2] -= 0.25 * (grid[y + 1, x - 1] + grid[y - 1, x + 1])
    row[3], row[4] = 1.0, grid[y, x]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _best_change(
    grid: NDArray[np.float64],
    pixels: Pixels,
    count: int,
    low_x: int,
    low_y: int,
    best: NDArray[np.float64],
) -> None:
    """Fit the terms (5,) of `_write_terms` to the grey levels; the grid has the picture, or NaN."""
    design, right = np.zeros((5, 5)), np.zeros(5)
    row = np.empty(5)
    for i in range(count):
        y, x = pixels.where[0, i] - low_y, pixels.where[1, i] - low_x
        if not (0 < y < grid.shape[0] - 1 and 0 < x < grid.shape[1] - 1):
            continue
        _write_terms(grid, y, x, row)
        if not np.all(np.isfinite(row)):
            continue
        for a in range(5):
            right[a] += row[a] * pixels.values[i]
            for b in range(5):
                design[a, b] += row[a] * row[b]
    for a in range(5):
        design[a, a] += 1e-6
    best[:] = np.linalg.solve(design, right)


@njit(cache=True)  # type: ignore[untyped-decorator]
def guess_smear(
    image: NDArray[np.uint8],
    pattern: Pattern,
    corners: NDArray[np.float64],
    bend: NDArray[np.float64],
    blur: float,
    smear: NDArray[np.float64],
) -> float:
    """Guess the smear from how residuals of a fit without one follow second derivatives.

    To second order a smear s adds s sᵀ / 12 to the covariance of the blur, and a change Σ of that
    covariance adds Σ : ∇∇ / 2 of the picture. The anisotropic part of the best Σ gives direction
    and length; its sign cannot be told and does not matter.

    Args:
        image: grey image.
        pattern: of the tag.
        corners: (4, 2) px of the fit.
        bend: (6,) of `lens.local_bend` there.
        blur: of the fit [px].
        smear: (2,) px, output.

    Returns:
        The standard deviation of the blur without the smear's share [px].
    """
    centre = np.array([corners[:, 0].mean(), corners[:, 1].mean()])
    h = np.empty(9)
    straight = corners - centre
    straighten(bend, straight)
    h[:8] = square_to_quad(straight)
    h[8] = 1.0
    cell = side_length(corners) / pattern.border
    around = int(1.2 * pattern.rim * cell) + 2
    low_x, low_y = int(corners[:, 0].min()) - around, int(corners[:, 1].min()) - around
    high_x, high_y = int(corners[:, 0].max()) + around + 2, int(corners[:, 1].max()) + around + 2
    room = (high_x - low_x + 1) * (high_y - low_y + 1)
    smear[:] = 0.0
    pixels = new_pixels(room)
    rows, where = pixels.rows, pixels.where
    view = View(image, pattern, cell, 2.0 * blur / cell, 1, centre, bend)
    count = sample_model(view, h, np.array([blur, 0.0, 0.0, 0.0]), pixels)
    if count < 60:
        return blur
    grid = np.full((high_y - low_y + 1, high_x - low_x + 1), np.nan)
    for i in range(count):
        grid[where[0, i] - low_y, where[1, i] - low_x] = rows[13, i]
    best = np.empty(5)
    _best_change(grid, pixels, count, low_x, low_y, best)
    return float(_split(best / max(best[4], 4.0), blur, smear))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _split(wider: NDArray[np.float64], blur: float, smear: NDArray[np.float64]) -> float:
    """Split a change of the blur's covariance, xx yy xy [px²], into smear and blur (returned)."""
    xx, yy, xy = wider[0], wider[1], wider[2]
    half, difference = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    length = math.sqrt(24.0 * difference)
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    smear[0], smear[1] = length * math.cos(angle), length * math.sin(angle)
    return math.sqrt(max(blur**2 + half - difference, _LEAST_BLUR**2))
