"""Corners of tags from the edges of their black border, to a few hundredths of a pixel.

Along each side, profiles are taken across the border. The border is where the centroid of the
profile's slope lies under a Gaussian window: this does not depend on the levels of black and white,
nor on light that changes slowly, and a symmetric blur does not move it. A line goes through the
crossings of a side, outliers are taken out, and neighbouring lines are intersected. Passes are
repeated from the corners of the one before until these stay.

The covariance of the corners is that of the crossings about their lines.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

SIDE_VALUES = 7
"""A fitted side has its middle x and y [px], its direction x and y, the variances of its offset
[px²] and of its angle [rad²], and the RMS residual of its crossings [px]."""

_MAX_SAMPLES = 96
"""A side is crossed by at most this many profiles."""

_PROFILE = 9
"""A profile has this many samples."""

_GAUSSIAN = 0.9
"""The Gaussian window in which slopes count has this standard deviation [px]."""

_USUAL_BLUR = 0.7
"""Edges of a sharp picture have this standard deviation, lens and pixel together [px]."""

_COARSE_PASSES, _FINE_PASSES = 3, 8

_NEAR = 0.5
"""Coarse passes end when no corner moves further than this [px]."""

_SETTLED = 0.02
"""Fine passes end when no corner moves further than this [px]."""

_LEAST_CONTRAST = 8.0
"""A side whose white is not brighter than its black by this is no side [grey levels]."""

_MODEL_ERROR = 0.004
"""Crossings scatter by this at least, whatever the noise [px]."""


@njit(cache=True)
def sample(image: NDArray[np.uint8], x: float, y: float) -> float:
    """Return the bilinear intensity at a point well inside of the image."""
    column, row = np.uintp(x), np.uintp(y)
    a, b = x - column, y - row
    one = np.uintp(1)
    top = image[row, column] * (1.0 - a) + image[row, column + one] * a
    low = image[row + one, column] * (1.0 - a) + image[row + one, column + one] * a
    return float(top * (1.0 - b) + low * b)


@njit(cache=True)
def inside(image: NDArray[np.uint8], x: float, y: float) -> bool:
    """Tell whether a point can be sampled."""
    return bool(0.0 <= x < image.shape[1] - 1.001 and 0.0 <= y < image.shape[0] - 1.001)


@njit(cache=True)
def _coarse_crossings(
    slopes: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the offset (n,) [px] of the edge from the middle of each profile.

    It is the centroid of the squared slopes: pulled little by the cells further in, though a bit
    toward pixel centres.

    Args:
        slopes: (n, m) grey levels from each sample of a profile to the next.
        places: (m,) px, where these are.
    """
    squares = np.maximum(slopes, 0.0) ** 2
    return (squares @ places) / np.maximum(squares @ np.ones_like(places), 1e-12)


@njit(cache=True)
def _fine_crossings(
    slopes: NDArray[np.float64], places: NDArray[np.float64], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the same by the centroid of the slope under a Gaussian.

    The contrast is that of the whole side, which keeps the noise of single profiles out. An edge in
    the middle stays in the middle whatever its blur; one beside it is pulled toward the middle,
    which the gain undoes for a usual blur and the next pass for any.
    """
    weights = np.exp(-0.5 * (places / _GAUSSIAN) ** 2)
    contrast = np.sum((slopes @ weights) * usable) / max(usable.sum(), 1)
    gain = 1.0 + _USUAL_BLUR**2 / _GAUSSIAN**2
    return (slopes @ (weights * places)) * (gain / contrast if contrast > 0.0 else 1.0)


@njit(cache=True)
def _fit_line(
    along: NDArray[np.float64], across: NDArray[np.float64], usable: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Fit across = middle + slope along, three times, leaving out what is far off.

    Returns:
        Middle, slope, mean and spread of `along`, RMS residual and number of points used, which is
        zero if there is no line.
    """
    weights, result = usable.astype(np.float64), np.zeros(6)
    for _ in range(3):
        count = weights.sum()
        if count < 5.0:
            return np.zeros(6)
        mean = (weights @ along) / count
        lever = weights * (along - mean)
        spread = lever @ along
        if spread < 1e-6:
            return np.zeros(6)
        slope = (lever @ across) / spread
        middle = (weights @ across) / count - slope * mean
        off = across - middle - slope * along
        rms = math.sqrt((weights * off) @ off / max(count - 2.0, 1.0))
        weights *= np.abs(off) <= max(3.0 * rms, 0.05)
        result[:] = (middle, slope, mean, spread, rms, count)
    return result


@njit(cache=True)
def _fit_side(
    image: NDArray[np.uint8],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    turn: float,
    window: float,
    coarse: bool,
    fitted: NDArray[np.float64],
) -> bool:
    """Fit the line of one side and write it, see `SIDE_VALUES`; False if there is no side."""
    length = math.hypot(end[0] - start[0], end[1] - start[1])
    if length < 4.0:
        return False
    tx, ty = (end[0] - start[0]) / length, (end[1] - start[1]) / length
    nx, ny = turn * ty, -turn * tx
    middle_x, middle_y = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
    inset = min(max(1.5, 0.05 * length), 0.25 * length)
    count = min(max(int(length - 2.0 * inset), 6), _MAX_SAMPLES)
    spacing = (length - 2.0 * inset) / (count - 1)
    along = inset + np.arange(count) * spacing - 0.5 * length
    profiles = np.zeros((count, _PROFILE))
    step = 2.0 * window / (_PROFILE - 1)
    for i in range(count):
        px, py = middle_x + along[i] * tx, middle_y + along[i] * ty
        x, y = px - window * nx, py - window * ny
        if not (inside(image, x, y) and inside(image, px + window * nx, py + window * ny)):
            continue
        for k in range(_PROFILE):
            profiles[i, k] = sample(image, x + k * step * nx, y + k * step * ny)
    slopes = profiles[:, 1:] - profiles[:, :-1]
    places = -window + (np.arange(_PROFILE - 1) + 0.5) * step
    contrasts = (np.maximum(slopes, 0.0) if coarse else slopes) @ np.ones_like(places)
    typical = np.median(contrasts)
    if typical < _LEAST_CONTRAST:
        return False
    usable = contrasts > 0.6 * typical
    if coarse:
        across = _coarse_crossings(slopes, places)
    else:
        across = _fine_crossings(slopes, places, usable)
    usable &= np.abs(across) < 0.95 * window
    middle, slope, mean, spread, rms, used = _fit_line(along, across, usable)
    if used == 0.0:
        return False
    dx, dy = tx + slope * nx, ty + slope * ny
    norm = math.hypot(dx, dy)
    # Neighbouring profiles share pixels, which makes about two of them worth one.
    variance = 2.0 * max(rms, _MODEL_ERROR) ** 2
    fitted[0], fitted[1] = middle_x + middle * nx, middle_y + middle * ny
    fitted[2], fitted[3] = dx / norm, dy / norm
    fitted[4] = variance / used + variance * mean**2 / spread
    fitted[5] = variance / spread
    fitted[6] = rms
    return True


@njit(cache=True)
def _refine(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    window: float,
    coarse: bool,
    sides: NDArray[np.float64],
) -> bool:
    """Fit the four sides (4, 7) and move the corners to where they meet, until they stay there."""
    area = 0.0
    for i in range(4):
        j = (i + 1) % 4
        area += corners[i, 0] * corners[j, 1] - corners[j, 0] * corners[i, 1]
    turn = 1.0 if area > 0.0 else -1.0
    for _ in range(_COARSE_PASSES if coarse else _FINE_PASSES):
        start = corners.copy()
        for i in range(4):
            end = start[(i + 1) % 4]
            if not _fit_side(image, start[i], end, turn, window, coarse, sides[i]):
                return False
        for i in range(4):
            before, after = sides[(i + 3) % 4], sides[i]
            determinant = before[2] * after[3] - before[3] * after[2]
            if abs(determinant) < 0.2:
                return False
            gx, gy = after[0] - before[0], after[1] - before[1]
            reach = (gx * after[3] - gy * after[2]) / determinant
            corners[i, 0] = before[0] + reach * before[2]
            corners[i, 1] = before[1] + reach * before[3]
        if np.abs(corners - start).max() < (_NEAR if coarse else _SETTLED):
            break
    return True


@njit(cache=True)
def refine_quads(
    image: NDArray[np.uint8], quads: NDArray[np.float64], search: float
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.bool_],
]:
    """Refine the corners of black quadrilaterals on white.

    Args:
        image: grey image.
        quads: (n, 4, 2) px, corners to start from, in either sense of rotation.
        search: largest distance of a side from where it starts [px]; cut to the width of a cell.

    Returns:
        Corners (n, 4, 2) px; their covariances (n, 8, 8) px², of x0 y0 x1 …; the RMS distance (n,)
        of the border's crossings from the four lines [px]; and whether all four sides were there.
    """
    count = quads.shape[0]
    corners, covariances = quads.copy(), np.zeros((count, 8, 8))
    residuals, found = np.zeros(count), np.zeros(count, dtype=np.bool_)
    sides = np.empty((4, SIDE_VALUES))
    for i in range(count):
        shortest = 1e9
        for k in range(4):
            j = (k + 1) % 4
            side = math.hypot(quads[i, j, 0] - quads[i, k, 0], quads[i, j, 1] - quads[i, k, 1])
            shortest = min(shortest, side)
        cell = shortest / 8.0
        wide = min(max(search, 1.0), 0.9 * cell + 0.4)
        fine = min(max(0.55 * cell, 1.1), 2.5)
        # A loop, since numba would compile a constant True and a constant False one by one.
        for coarse in (True, False):
            found[i] = _refine(image, corners[i], wide if coarse else fine, coarse, sides)
            if not found[i]:
                break
        if found[i]:
            residuals[i] = math.sqrt(np.mean(sides[:, 6] ** 2))
            covariances[i] = _corner_covariance(corners[i], sides)
    return corners, covariances, residuals, found


@njit(cache=True)
def _corner_covariance(
    corners: NDArray[np.float64], sides: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Propagate the variances of four lines (4, 7) to the corners they meet in, (8, 8) px².

    A line of normal n that moves by δ moves a corner, where it meets a line of direction t, by
    t δ / (t·n).
    """
    gain = np.zeros((8, 8))
    for side in range(4):
        before, end = (side + 3) % 4, (side + 1) % 4
        along_x, along_y = corners[end] - corners[side]
        half = 0.5 * math.hypot(along_x, along_y)
        for corner, other, lever in ((side, before, -half), (end, end, half)):
            tx, ty = sides[other, 2], sides[other, 3]
            across = ty * sides[side, 2] - tx * sides[side, 3]
            for axis, move in ((0, tx / across), (1, ty / across)):
                gain[2 * corner + axis, 2 * side] = move
                gain[2 * corner + axis, 2 * side + 1] = move * lever
    variances = sides[:, 4:6].copy().ravel()
    return (gain * variances) @ gain.T
