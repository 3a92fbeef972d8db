"""The pattern under a homography, a blur and a smear: grey levels and derivatives, by pixel."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.detection.alignment.pattern import EDGE_VALUES, Pattern, look_at

UNKNOWNS = 16
"""Homography (8), blur [px], smear x, y [px], turn during the exposure [rad], and what is linear:
offset, gain, slopes of the gain along both sides."""

RUN = 4
"""Neighbouring pixels of a row that are used or left out together."""

_SPACING = 0.9
"""Between the instants of a smear [px]; a blur of two thirds of it hides the steps."""


class View(NamedTuple):
    """A tag in a picture.

    Attributes:
        image: grey image.
        pattern: of the tag.
        cell: edge of a cell [px].
        reach: so far from the edge of its rim a tag is looked at [cells].
        stride: of so many runs of pixels one is used, another one in every row, so that edges of
            all directions are seen.
        centre: (2,) px, the origin of the homography's coordinates.
        bend: (6,) of `lens.local_bend`: the homography is that of the straightened pixels.
    """

    image: NDArray[np.uint8]
    pattern: Pattern
    cell: float
    reach: float
    stride: int
    centre: NDArray[np.float64]
    bend: NDArray[np.float64]


class Pixels(NamedTuple):
    """What is known of the pixels of a tag.

    Attributes:
        rows: (16, n) derivatives of the bare pattern by homography, blur, smear and turn (not times
            the gain), and the linear terms themselves.
        values: (n,) grey levels.
        where: (2, n) row and column in the image.
        weights: (n,) of the fit.
        residual: (n,) grey level less what the fit says.
    """

    rows: NDArray[np.float64]
    values: NDArray[np.float64]
    where: NDArray[np.int64]
    weights: NDArray[np.float64]
    residual: NDArray[np.float64]


@njit(cache=True)  # type: ignore[untyped-decorator]
def new_pixels(room: int) -> Pixels:
    """Return room for the pixels of a tag."""
    return Pixels(
        np.empty((UNKNOWNS, room)),
        np.empty(room),
        np.empty((2, room), dtype=np.int64),
        np.ones(room),
        np.empty(room),
    )


@njit(cache=True)  # type: ignore[untyped-decorator]
def inverse(h: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse of a homography with h[8] = 1, up to scale, (9,)."""
    out = np.empty(9)
    out[0] = h[4] - h[5] * h[7]
    out[1] = h[2] * h[7] - h[1]
    out[2] = h[1] * h[5] - h[2] * h[4]
    out[3] = h[5] * h[6] - h[3]
    out[4] = h[0] - h[2] * h[6]
    out[5] = h[2] * h[3] - h[0] * h[5]
    out[6] = h[3] * h[7] - h[4] * h[6]
    out[7] = h[1] * h[6] - h[0] * h[7]
    out[8] = h[0] * h[4] - h[1] * h[3]
    return out


@njit(cache=True)  # type: ignore[untyped-decorator]
def write_corners(h: NDArray[np.float64], corners: NDArray[np.float64]) -> None:
    """Write where the corners of the unit square go, (4, 2)."""
    for k in range(4):
        u = 1.0 if k in {1, 2} else 0.0
        v = 1.0 if k in {2, 3} else 0.0
        w = h[6] * u + h[7] * v + 1.0
        corners[k, 0] = (h[0] * u + h[1] * v + h[2]) / w
        corners[k, 1] = (h[3] * u + h[4] * v + h[5]) / w


@njit(cache=True, inline="always")  # type: ignore[untyped-decorator]
def straightened(bend: NDArray[np.float64], x: float, y: float) -> tuple[float, float]:
    """Return where a point about the centre would be without the lens's bend."""
    return (
        x + (bend[0] * x + bend[1] * y) * x + bend[2] * y * y,
        y + (bend[3] * x + bend[4] * y) * x + bend[5] * y * y,
    )


@njit(cache=True)  # type: ignore[untyped-decorator]
def straighten(bend: NDArray[np.float64], points: NDArray[np.float64]) -> None:
    """Take the lens's bend out of points (n, 2) about the centre."""
    for k in range(points.shape[0]):
        points[k, 0], points[k, 1] = straightened(bend, points[k, 0], points[k, 1])


@njit(cache=True)  # type: ignore[untyped-decorator]
def bend_back(bend: NDArray[np.float64], points: NDArray[np.float64]) -> None:
    """Put the lens's bend into points (n, 2): the inverse of `straighten`, by iteration."""
    for k in range(points.shape[0]):
        x, y = points[k, 0], points[k, 1]
        for _ in range(4):
            u, v = straightened(bend, points[k, 0], points[k, 1])
            points[k, 0] += x - u
            points[k, 1] += y - v


@njit(cache=True)  # type: ignore[untyped-decorator]
def corner_slopes(h: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the derivative of the corners x0 y0 x1 … by the homography, (8, 8)."""
    slopes = np.zeros((8, 8))
    for k in range(4):
        u = 1.0 if k in {1, 2} else 0.0
        v = 1.0 if k in {2, 3} else 0.0
        w = h[6] * u + h[7] * v + 1.0
        x = (h[0] * u + h[1] * v + h[2]) / w
        y = (h[3] * u + h[4] * v + h[5]) / w
        for axis in range(2):
            row, place = 2 * k + axis, x if axis == 0 else y
            slopes[row, 3 * axis] = u / w
            slopes[row, 3 * axis + 1] = v / w
            slopes[row, 3 * axis + 2] = 1.0 / w
            slopes[row, 6] = -place * u / w
            slopes[row, 7] = -place * v / w
    return slopes


@njit(cache=True)  # type: ignore[untyped-decorator]
def side_length(corners: NDArray[np.float64]) -> float:
    """Return the mean length of the sides [px]."""
    total = 0.0
    for k in range(4):
        n = (k + 1) % 4
        total += math.hypot(corners[n, 0] - corners[k, 0], corners[n, 1] - corners[k, 1])
    return 0.25 * total


@njit(cache=True)  # type: ignore[untyped-decorator]
def _bounds(h: NDArray[np.float64], rim: float) -> tuple[float, float, float, float]:
    """Return the range of x and of y that a tag with its rim, in sides of the border, covers."""
    low_x = low_y = 1e9
    high_x = high_y = -1e9
    for k in range(4):
        u = 1.0 + rim if k in {1, 2} else -rim
        v = 1.0 + rim if k in {2, 3} else -rim
        w = h[6] * u + h[7] * v + 1.0
        x, y = (h[0] * u + h[1] * v + h[2]) / w, (h[3] * u + h[4] * v + h[5]) / w
        low_x, high_x = min(low_x, x), max(high_x, x)
        low_y, high_y = min(low_y, y), max(high_y, y)
    return low_x, high_x, low_y, high_y


@njit(cache=True, fastmath=True, error_model="numpy", forceinline=True)  # type: ignore[untyped-decorator]
def _average(
    cells: NDArray[np.float64],
    blur: float,
    c: float,
    r: float,
    dc: float,
    dr: float,
    instants: int,
    across: NDArray[np.float64],
    down: NDArray[np.float64],
) -> tuple[float, float, float, float, float, float]:
    """Average the pattern over the way of a pixel through it, (dc, dr) cells about (c, r).

    Returns:
        Value, derivatives by column, row and blur, means of the first two times the instant.
    """
    value, by_c, by_r, by_blur, along_c, along_r = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(instants):
        t = (k + 0.5) / instants - 0.5
        seen, g, f, wider = look_at(cells, blur, c + t * dc, r + t * dr, across, down)
        value += seen
        by_c += g
        by_r += f
        by_blur += wider
        along_c += t * g
        along_r += t * f
    share = 1.0 / instants
    return (
        value * share,
        by_c * share,
        by_r * share,
        by_blur * share,
        along_c * share,
        along_r * share,
    )


@njit(cache=True)  # type: ignore[untyped-decorator]
def _pixels_of(view: View, h: NDArray[np.float64]) -> tuple[int, int, int, int]:
    """Return the first and last row and column of the image that a tag with its rim covers."""
    image, centre = view.image, view.centre
    low_x, high_x, low_y, high_y = _bounds(h, view.pattern.rim / view.pattern.border)
    return (
        max(int(low_y + centre[1]), 0),
        min(int(high_y + centre[1]) + 1, image.shape[0] - 1),
        max(int(low_x + centre[0]), 0),
        min(int(high_x + centre[0]) + 1, image.shape[1] - 1),
    )


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _write_homography(
    rows: NDArray[np.float64],
    i: int,
    gx: float,
    gy: float,
    u: float,
    v: float,
    w: float,
    along: float,
) -> None:
    """Write derivatives of one pixel by the homography, from those by its place (gx, gy)."""
    rows[0, i], rows[1, i], rows[2, i] = -gx * u * w, -gx * v * w, -gx * w
    rows[3, i], rows[4, i], rows[5, i] = -gy * u * w, -gy * v * w, -gy * w
    rows[6, i], rows[7, i] = along * u * w, along * v * w


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")  # type: ignore[untyped-decorator]
def _square_at(
    back: NDArray[np.float64], x: float, y: float, border: float
) -> tuple[float, float, float, float, float, float]:
    """Return u, v of a pixel in the unit square, and their derivatives in cells a pixel."""
    scale = 1.0 / (back[6] * x + back[7] * y + back[8])
    u = (back[0] * x + back[1] * y + back[2]) * scale
    v = (back[3] * x + back[4] * y + back[5]) * scale
    cells = scale * border
    return (
        u,
        v,
        (back[0] - u * back[6]) * cells,
        (back[1] - u * back[7]) * cells,
        (back[3] - v * back[6]) * cells,
        (back[4] - v * back[7]) * cells,
    )


@njit(cache=True, fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def sample_model(
    view: View, h: NDArray[np.float64], state: NDArray[np.float64], pixels: Pixels
) -> int:
    """Write derivatives, linear terms, grey levels and places of the pixels that the tag covers.

    Args:
        view: the tag.
        h: (9,) homography from the unit square to pixels about the view's centre.
        state: (4,) blur and smear [px], turn during the exposure [rad].
        pixels: output.

    Returns:
        How many pixels there are.
    """
    cells, centre, cell, rows = view.pattern.cells, view.centre, view.cell, pixels.rows
    border, rim = view.pattern.border, view.pattern.rim
    whole, blur = border + 2.0 * rim, state[0] / cell
    smeared = state[1] != 0.0 or state[2] != 0.0 or state[3] != 0.0
    back = inverse(h)
    across, down_edges = np.empty((2, cells.shape[0], EDGE_VALUES))
    first_row, last_row, first, last = _pixels_of(view, h)
    count = 0
    for row in range(first_row, last_row + 1):
        down = row - centre[1]
        start = first // RUN
        for block in range(start + (-start - row) % view.stride, last // RUN + 1, view.stride):
            for column in range(max(block * RUN, first), min(block * RUN + RUN - 1, last) + 1):
                if count >= pixels.values.shape[0]:
                    return count
                x, y = straightened(view.bend, column - centre[0], down)
                u, v, ux, uy, vx, vy = _square_at(back, x, y, border)
                # Columns of cells run to the right and rows down, from the rim's corner; the
                # pattern has one more cell around it.
                c, r = u * border + rim, (1.0 - v) * border + rim
                smear_x, smear_y = state[1] - state[3] * y, state[2] + state[3] * x
                dc, dr = ux * smear_x + uy * smear_y, -(vx * smear_x + vy * smear_y)
                edge_c, edge_r = 0.5 * abs(dc) + view.reach, 0.5 * abs(dr) + view.reach
                if c < edge_c or c > whole - edge_c or r < edge_r or r > whole - edge_r:
                    continue
                instants = 1
                if smeared:
                    instants = int(math.sqrt(smear_x**2 + smear_y**2) / _SPACING) + 3
                value, by_c, by_r, by_blur, along_c, along_r = _average(
                    cells, blur, c + 1.0, r + 1.0, dc, dr, instants, across, down_edges
                )
                # Derivatives by the pixel.
                gx, gy = by_c * ux - by_r * vx, by_c * uy - by_r * vy
                w = 1.0 / (h[6] * u + h[7] * v + 1.0)
                _write_homography(rows, count, gx, gy, u, v, w, gx * x + gy * y)
                rows[8, count] = by_blur / cell
                rows[9, count] = along_c * ux - along_r * vx
                rows[10, count] = along_c * uy - along_r * vy
                rows[11, count] = x * rows[10, count] - y * rows[9, count]
                rows[12, count], rows[13, count] = 1.0, value
                rows[14, count], rows[15, count] = value * (u - 0.5), value * (v - 0.5)
                pixels.values[count] = view.image[row, column]
                pixels.where[0, count], pixels.where[1, count] = row, column
                count += 1
    return count
