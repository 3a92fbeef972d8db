"""Place a tag by fitting its whole printed pattern to the pixels (photometric alignment).

The model of a pixel is offset + (gain + slopes) × the printed pattern, seen through a homography,
a Gaussian blur and a linear smear (the mean along the way that the tag goes during the exposure).
All of it is fitted to the grey levels by Gauss-Newton with analytic derivatives; pixels that do not
fit, as where something covers the tag, lose their weight. The covariance of the corners
is that of the fit: noise of the pixels, as the residuals show it, through the same derivatives.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.camera.lens import local_bend
from apriltag_tracker.detection.alignment.pattern import Pattern
from apriltag_tracker.detection.alignment.sampling import (
    RUN,
    UNKNOWNS,
    Pixels,
    View,
    bend_back,
    corner_slopes,
    new_pixels,
    sample_model,
    side_length,
    straighten,
    write_corners,
)
from apriltag_tracker.detection.alignment.weights import (
    QUANTISATION,
    neighbours_alike,
    weigh,
)
from apriltag_tracker.detection.decoding import square_to_quad

RESULT_VALUES = 9
"""Blur, smear x, smear y [px], explained share of all pixels, residual [grey levels], share of the
weight that was kept, gain [grey levels], correlation of neighbouring residuals, turn [rad]."""

_BLUR, _SMEAR, _TURN, _LINEAR = 8, 9, 11, 12
_LARGEST_STEP = 0.04
"""Of the turn [rad]."""

_MOST_PIXELS, _MOST_SMEARED = 1700.0, 2600.0
"""Of the rectangle around a tag; a smear takes more of them to be told."""

_LEAST_BLUR, _MOST_BLUR = 0.32, 4.0
_PERSPECTIVE = 1.04
"""By so much the near part of a tag is larger than the mean."""

_SETTLED = 0.03
"""Steps end when no corner moves further [px]; what is left after such a step is a tenth of it."""

_FEWEST = 60
"""Pixels that a fit needs."""

_MODEL_ERROR = 0.003
"""What the model leaves out, whatever the noise, moves a corner by so much [px]."""

_WIDE, _WIDE_ERROR = 0.8, 0.02
"""Beyond this blur [px], what the model leaves out grows by so much a pixel of blur: lenses out of
focus are no Gaussians, and what lies beyond the sheet's edge is blurred into the sheet."""

_PASSES = 9
"""Steps of one fit at most."""

_OTHER_BLUR = math.log(1.09)
"""A fit whose blur comes out further from where it began, as a ratio, is made again from there: by
the blur it is decided how near to the edge of the rim a pixel still shows the tag alone."""

_CAREFUL = 4
"""Steps after which weights change by half only, so that they cannot go to and fro for ever."""


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _weighted_normal(
    rows: NDArray[np.float64],
    residual: NDArray[np.float64],
    weights: NDArray[np.float64],
    first: int,
    count: int,
    held: bool,
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Accumulate the normal equations from `first` on; smear and turn may be `held`."""
    for a in range(first, rows.shape[0]):
        if held and _SMEAR <= a < _LINEAR:
            continue
        scaled = rows[a, :count] * weights[:count]
        total = 0.0
        for i in range(count):
            total += scaled[i] * residual[i]
        right[a] = total
        for b in range(first, a + 1):
            if held and _SMEAR <= b < _LINEAR:
                continue
            total = 0.0
            for i in range(count):
                total += scaled[i] * rows[b, i]
            normal[a, b] = total
            normal[b, a] = total


@njit(cache=True)  # type: ignore[untyped-decorator]
def _linear_terms(
    rows: NDArray[np.float64],
    values: NDArray[np.float64],
    weights: NDArray[np.float64],
    count: int,
    linear: NDArray[np.float64],
) -> None:
    """Fit offset, gain and slopes, which are linear, for the present geometry."""
    normal = np.zeros((UNKNOWNS, UNKNOWNS))
    right = np.zeros(UNKNOWNS)
    _weighted_normal(rows, values, weights, _LINEAR, count, False, normal, right)
    block = normal[_LINEAR:, _LINEAR:].copy()
    for k in range(4):
        block[k, k] = block[k, k] * (1.0 + 1e-9) + 1e-6
    linear[:] = np.linalg.solve(block, right[_LINEAR:])


@njit(cache=True)  # type: ignore[untyped-decorator]
def _judge(
    pixels: Pixels, count: int, move: NDArray[np.float64], result: NDArray[np.float64]
) -> None:
    """Take the last step off the residuals; write shares explained and kept, and the residual."""
    values, weights, residual = pixels.values, pixels.weights, pixels.residual
    for a in range(UNKNOWNS):
        if move[a] != 0.0:
            for i in range(count):
                residual[i] -= move[a] * pixels.rows[a, i]
    mean = values[:count].mean()
    kept, square, all_square, whole = 0.0, 0.0, 0.0, 1e-9
    for i in range(count):
        off = residual[i] ** 2
        kept += weights[i]
        square += weights[i] * off
        all_square += off
        whole += (values[i] - mean) ** 2
    result[3] = 1.0 - all_square / whole
    result[4] = max(math.sqrt(square / max(kept - UNKNOWNS, 10.0)), QUANTISATION)
    result[5] = kept / count
    result[7] = neighbours_alike(residual, weights, pixels.where, count)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _prepare(
    pixels: Pixels, count: int, share: float, stride: int, result: NDArray[np.float64]
) -> bool:
    """Fit the light, write residuals and weights; derivatives become those of the grey level."""
    rows, residual = pixels.rows, pixels.residual
    linear = np.zeros(4)
    _linear_terms(rows, pixels.values, pixels.weights, count, linear)
    gain = linear[1]
    result[6] = gain
    if gain < 4.0:
        return False
    for i in range(count):
        seen = linear[0] + gain * rows[13, i] + linear[2] * rows[14, i] + linear[3] * rows[15, i]
        residual[i] = pixels.values[i] - seen
    weigh(residual, pixels.weights, pixels.where, count, share, stride)
    # The slopes of the light are small: derivatives take the gain of the tag's middle.
    for a in range(_LINEAR):
        for i in range(count):
            rows[a, i] *= gain
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]
def _hold_smear(normal: NDArray[np.float64], right: NDArray[np.float64]) -> None:
    """Take smear and turn out of the unknowns."""
    for a in range(_SMEAR, _LINEAR):
        normal[a, :] = 0.0
        normal[:, a] = 0.0
        normal[a, a] = 1.0
        right[a] = 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _advance(
    state: NDArray[np.float64], h: NDArray[np.float64], move: NDArray[np.float64]
) -> float:
    """Take one step; returns by how much the blur changed. Blur and smear change by little."""
    blur = min(max(move[_BLUR], -0.35 * state[0]), 0.35 * state[0])
    before = state[0]
    state[0] = min(max(before + blur, _LEAST_BLUR), _MOST_BLUR)
    share = min(1.0, 1.5 / max(math.hypot(move[_SMEAR], move[_SMEAR + 1]), 1e-9))
    state[1] += share * move[_SMEAR]
    state[2] += share * move[_SMEAR + 1]
    state[3] += min(max(move[_TURN], -_LARGEST_STEP), _LARGEST_STEP)
    h[:8] += move[:8]
    return float(abs(state[0] - before))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _finish(
    h: NDArray[np.float64],
    normal: NDArray[np.float64],
    blur: float,
    count: int,
    result: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> None:
    """Write the covariance of the corners."""
    # Of pixels that have nothing in common the correlation is seldom above this either.
    residual, alike = result[4], max(result[7] - 1.0 / math.sqrt(count), 0.0)
    slopes = corner_slopes(h)
    spread = np.ascontiguousarray(np.linalg.inv(normal)[:8, :8])
    variance = residual**2 * ((1.0 + alike) / (1.0 - alike)) ** 2
    covariance[:] = variance * (slopes @ spread @ np.ascontiguousarray(slopes.T))
    for a in range(8):
        covariance[a, a] += _MODEL_ERROR**2 + (_WIDE_ERROR * max(blur - _WIDE, 0.0)) ** 2


@njit(cache=True)  # type: ignore[untyped-decorator]
def _write_normal(
    pixels: Pixels,
    count: int,
    free_smear: bool,
    normal: NDArray[np.float64],
    right: NDArray[np.float64],
) -> None:
    """Write the normal equations of all unknowns that are free."""
    _weighted_normal(
        pixels.rows, pixels.residual, pixels.weights, 0, count, not free_smear, normal, right
    )
    if not free_smear:
        _hold_smear(normal, right)
    for a in range(UNKNOWNS):
        normal[a, a] = normal[a, a] * (1.0 + 1e-9) + 1e-9
    # Of a tag that hardly moves the turn's sign, and so the turn, is open.
    normal[_TURN, _TURN] += 4.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _stride_and_room(
    start: NDArray[np.float64], pattern: Pattern, free_smear: bool
) -> tuple[int, int]:
    """Return of how many runs of pixels one is used, and for how many there must be room."""
    whole = _PERSPECTIVE * (1.0 + 2.0 * pattern.rim / pattern.border)
    wide = (start[:, 0].max() - start[:, 0].min()) * whole + 4.0
    high = (start[:, 1].max() - start[:, 1].min()) * whole + 4.0
    stride = 1 + int(wide * high / (_MOST_SMEARED if free_smear else _MOST_PIXELS))
    return stride, int(high + 4.0) * int(wide / stride + 2.0 * RUN)


@njit(cache=True)  # type: ignore[untyped-decorator]
def _begin(
    corners: NDArray[np.float64], result: NDArray[np.float64], free_smear: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the homography (9,), and blur, smear [px] and turn [rad] (4,), to start from."""
    h = np.empty(9)
    h[:8] = square_to_quad(corners)
    h[8] = 1.0
    blur = min(max(result[0], _LEAST_BLUR), _MOST_BLUR)
    state = np.array([blur, result[1], result[2], result[8]])
    if not free_smear:
        state[1:] = 0.0
    return h, state


@njit(cache=True)  # type: ignore[untyped-decorator]
def _take(
    view: View,
    h: NDArray[np.float64],
    state: NDArray[np.float64],
    pixels: Pixels,
    before: int,
    step: int,
    result: NDArray[np.float64],
) -> int:
    """Sample the pixels, fit the light and weigh; returns how many there are, 0 if too few."""
    count = sample_model(view, h, state, pixels)
    if count < _FEWEST:
        return 0
    if count != before:
        pixels.weights[:count] = 1.0
    share = 1.0 if step < _CAREFUL else 0.5
    return count if _prepare(pixels, count, share, view.stride, result) else 0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _align(
    image: NDArray[np.uint8],
    pattern: Pattern,
    start: NDArray[np.float64],
    bend: NDArray[np.float64],
    free_smear: bool,
    corners: NDArray[np.float64],
    covariance: NDArray[np.float64],
    result: NDArray[np.float64],
) -> bool:
    """Fit one tag.

    Args:
        image: grey image.
        pattern: of the tag.
        start: (4, 2) px, corners to start from, from the printed lower left counter-clockwise.
        bend: (6,) of `lens.local_bend` at the tag.
        free_smear: whether smear and turn are fitted; they cannot both start from zero, where the
            directions of a smear are alike.
        corners: (4, 2) px, output.
        covariance: (8, 8) px² of the corners x0 y0 x1 …, output.
        result: (9,) output, see `RESULT_VALUES`; blur, smear and turn in it say where to start.

    Returns:
        Whether the fit settled.
    """
    centre = np.array([start[:, 0].mean(), start[:, 1].mean()])
    corners[:] = start - centre
    straighten(bend, corners)
    h, state = _begin(corners, result, free_smear)
    side = side_length(start)
    stride, room = _stride_and_room(start, pattern, free_smear)
    cell = side / pattern.border
    # The pixels that count stay the same while the blur changes: it is the start's.
    view = View(image, pattern, cell, 2.0 * state[0] / cell, stride, centre, bend)
    pixels = new_pixels(room)
    normal, right = np.zeros((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS)
    moved, count = 0.0, 0
    for step in range(_PASSES):
        count = _take(view, h, state, pixels, count, step, result)
        if count == 0:
            return False
        _write_normal(pixels, count, free_smear, normal, right)
        move = np.linalg.solve(normal, right)
        last = corners.copy()
        widened = _advance(state, h, move)
        write_corners(h, corners)
        moved = np.abs(corners - last).max()
        if not moved < 0.5 * side:
            return False
        if moved < _SETTLED and widened < 0.03 * state[0]:
            break
    _judge(pixels, count, move, result)
    result[:3], result[8] = state[:3], state[3]
    _finish(h, normal, state[0], count, result, covariance)
    bend_back(bend, corners)
    corners += centre
    return moved < 0.1


@njit(cache=True)  # type: ignore[untyped-decorator]
def place(
    image: NDArray[np.uint8],
    pattern: Pattern,
    corners: NDArray[np.float64],
    matrix: NDArray[np.float64],
    distortion: NDArray[np.float64],
    free_smear: bool,
    placed: NDArray[np.float64],
    covariance: NDArray[np.float64],
    result: NDArray[np.float64],
) -> bool:
    """Fit one tag, once more where the blur came out to be another one.

    Args:
        image: grey image.
        pattern: of the tag.
        corners: (4, 2) px, to start from, from the printed lower left counter-clockwise.
        matrix: (3, 3) of the camera [px].
        distortion: (8,) of its lens.
        free_smear: whether smear and turn are fitted; they cannot both start from zero.
        placed: (4, 2) px, output.
        covariance: (8, 8) px² of the corners x0 y0 x1 …, output.
        result: (9,) output, see `RESULT_VALUES`; blur, smear and turn in it say where to start.

    Returns:
        Whether the fit settled.
    """
    bend, start = local_bend(corners, matrix, distortion), corners.copy()
    settled = False
    for attempt in range(3):
        begun = result[0]
        settled = _align(image, pattern, start, bend, free_smear, placed, covariance, result)
        if (not settled and attempt > 0) or not np.all(np.isfinite(placed)):
            return False
        if settled and abs(math.log(result[0] / begun)) < _OTHER_BLUR:
            break
        if settled:
            start[:] = placed
    # Of an arc by an angle a, the mean is nearer to its middle by a² / 24 than the tangent is:
    # through the arc a pixel sees more of the tag's middle, so that the tag looks larger.
    for axis in range(2):
        middle = placed[:, axis].mean()
        placed[:, axis] = middle + (placed[:, axis] - middle) * (1.0 - result[8] ** 2 / 24.0)
    return settled and bool(np.all(np.isfinite(covariance)))
