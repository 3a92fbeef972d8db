"""Images of tags in closed form: no texture is sampled, so corners are where they should be.

A pixel sees the printed pattern through a Gaussian, the lens's blur together with the pixel's own
area. Seen from the tag, this is a product of two error functions per cell, exact for a tag that is
not foreshortened much. Each pixel's ray comes from the exact inverse of the lens distortion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.camera.pinhole import distort
from apriltag_tracker.synthetic.shapes import Placements

PIXEL_VARIANCE = 1.0 / 12.0
"""Of a box of one pixel [px²]."""

_TABLE_STEPS = 1024
_TABLE_REACH = 3.5
_CUT = 3.0
"""Cells further away than so many standard deviations are not seen."""


class Eye(NamedTuple):
    """A camera and the light.

    Attributes:
        rotation: (3, 3) from `limb_base` into the camera's optical frame.
        translation: (3,) m, the same.
        matrix: (3, 3) of the camera [px].
        distortion: (8,) of the lens.
        rays: (rows, columns, 2) normalised coordinates of the pixels.
        light: (rows, columns) brightness of the light, 1 is nominal.
        blur: standard deviation of lens and pixel together [px].
        black: grey level of black cells in nominal light.
        white: grey level of white cells in nominal light.
        table: of `cumulative_table`.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]
    rays: NDArray[np.float32]
    light: NDArray[np.float32]
    blur: float
    black: float
    white: float
    table: NDArray[np.float64]


class Prints(NamedTuple):
    """Printed tags.

    Attributes:
        cells: (n, c, c) cells of each tag with its margin, 1 is white.
        border: cells along the border.
    """

    cells: NDArray[np.float64]
    border: float


class Seen(NamedTuple):
    """One tag as the camera sees it during an exposure.

    Attributes:
        maps: (k, 9) from rays to cells (column to the right, row downward), one for each instant of
            the exposure.
        across: standard deviation of blur and pixel along the columns of cells [cells].
        down: the same along the rows.
        cells: (n, n) printed cells with their margin, 1 is white.
    """

    maps: NDArray[np.float64]
    across: float
    down: float
    cells: NDArray[np.float64]


def cumulative_table() -> NDArray[np.float64]:
    """Return the Gaussian's cumulative distribution from −3.5 to 3.5 standard deviations."""
    grid = np.linspace(-_TABLE_REACH, _TABLE_REACH, _TABLE_STEPS + 1)
    return np.array([0.5 * (1.0 + math.erf(x / math.sqrt(2.0))) for x in grid])


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _cumulative(place: float, table: NDArray[np.float64]) -> float:
    """Look up the Gaussian's distribution at a place of the table, in its steps."""
    place = min(max(place, 0.0), _TABLE_STEPS - 1e-9)
    whole = np.intp(place)
    k = np.uintp(whole)
    return float(table[k] + (table[k + np.uintp(1)] - table[k]) * (place - whole))


@njit(cache=True, fastmath=True, error_model="numpy", inline="always")
def _shares(
    place: float,
    spread: float,
    count: int,
    table: NDArray[np.float64],
    shares: NDArray[np.float64],
) -> tuple[int, int, float]:
    """Write which share of a pixel each cell of a row of cells has.

    Args:
        place: of the pixel [cells].
        spread: standard deviation of what it sees [cells].
        count: of cells.
        table: of `cumulative_table`.
        shares: (count,) output from the first one on.

    Returns:
        The first cell and the one after the last one that are seen, and the share of all.
    """
    first = max(math.floor(place - _CUT * spread), 0)
    end = min(math.floor(place + _CUT * spread) + 1, count)
    if first >= end:
        return 0, 0, 0.0
    step = _TABLE_STEPS / (2.0 * _TABLE_REACH) / spread
    at = (first - place) * step + 0.5 * _TABLE_STEPS
    begin = last = _cumulative(at, table)
    for i in range(first, end):
        at += step
        following = _cumulative(at, table)
        shares[i - first] = following - last
        last = following
    return first, end, last - begin


@njit(cache=True, fastmath=True, error_model="numpy")
def _draw_box(
    canvas: NDArray[np.uint8],
    eye: Eye,
    noise: NDArray[np.int8],
    noise_start: int,
    box: tuple[int, int, int, int],
    seen: Seen,
) -> None:
    """Draw one tag into its bounding box.

    Args:
        canvas: (rows, columns) image that the tag is drawn over, noise already in it.
        eye: the camera.
        noise: (n,) grey levels, added to the tag's pixels from `noise_start` on.
        noise_start: place in the noise.
        box: first row, end row, first column, end column.
        seen: the tag.
    """
    cells, maps, table = seen.cells, seen.maps, eye.table
    count, share = cells.shape[0], 1.0 / maps.shape[0]
    across, down = np.empty(count), np.empty(count)
    position = noise_start
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            x, y = float(eye.rays[row, column, 0]), float(eye.rays[row, column, 1])
            cover, bright = 0.0, 0.0
            for k in range(maps.shape[0]):
                m = maps[k]
                scale = 1.0 / (m[6] * x + m[7] * y + m[8])
                u = (m[0] * x + m[1] * y + m[2]) * scale
                v = (m[3] * x + m[4] * y + m[5]) * scale
                left, right, wide = _shares(u, seen.across, count, table, across)
                if wide == 0.0:
                    continue
                top, bottom, high = _shares(v, seen.down, count, table, down)
                cover += share * wide * high
                for j in range(top, bottom):
                    line = 0.0
                    for i in range(left, right):
                        line += across[i - left] * cells[j, i]
                    bright += share * down[j - top] * line
            if cover <= 0.0:
                continue
            value = (eye.black * (cover - bright) + eye.white * bright) * eye.light[row, column]
            value += noise[position] * cover + (1.0 - cover) * canvas[row, column]
            position = position + 1 if position + 1 < noise.shape[0] else 0
            canvas[row, column] = int(min(max(value + 0.5, 0.0), 255.0))


@njit(cache=True)
def _write_corners(eye: Eye, placement: NDArray[np.float64], corners: NDArray[np.float64]) -> None:
    """Write the pixels (4, 2) of a placed tag's corners, from the printed lower left."""
    cosine, sine = math.cos(placement[3]), math.sin(placement[3])
    half = 0.5 * placement[4]
    point = np.empty(3)
    for k in range(4):
        u = half if k in {1, 2} else -half
        v = half if k in {2, 3} else -half
        point[0] = placement[0] + cosine * u - sine * v
        point[1] = placement[1] + sine * u + cosine * v
        point[2] = placement[2]
        seen = eye.rotation @ point + eye.translation
        x, y = distort(seen[0] / seen[2], seen[1] / seen[2], eye.distortion)
        corners[k, 0] = eye.matrix[0, 0] * x + eye.matrix[0, 1] * y + eye.matrix[0, 2]
        corners[k, 1] = eye.matrix[1, 1] * y + eye.matrix[1, 2]


@njit(cache=True)
def _write_map(
    eye: Eye, placement: NDArray[np.float64], prints: Prints, result: NDArray[np.float64]
) -> None:
    """Write the map (9,) from rays to cells (columns, rows downward) of one placed tag."""
    cosine, sine = math.cos(placement[3]), math.sin(placement[3])
    cell = placement[4] / prints.border
    half = 0.5 * prints.cells.shape[1]
    # Homogeneous (column, row, 1) -> point on the tag's plane in the camera's frame.
    right = cell * (eye.rotation[:, 0] * cosine + eye.rotation[:, 1] * sine)
    down = cell * (eye.rotation[:, 0] * sine - eye.rotation[:, 1] * cosine)
    origin = eye.rotation @ placement[:3] + eye.translation - half * (right + down)
    # Rows of the inverse of the matrix with these columns are their cross products, up to a factor.
    result[:3], result[3:6] = np.cross(down, origin), np.cross(origin, right)
    result[6:] = np.cross(right, down)


@njit(cache=True)
def _box_of(
    both: NDArray[np.float64], grown: float, blur: float, rows: int, columns: int
) -> tuple[int, int, int, int]:
    """Return first row, end row, first column, end column of a tag with its margin and blur.

    Args:
        both: (8, 2) px, its corners at the begin and at the end of the exposure.
        grown: its width with the margin over that of the border.
        blur: standard deviation [px].
        rows: of the picture.
        columns: of the picture.
    """
    middle_x, middle_y = both[:, 0].mean(), both[:, 1].mean()
    reach = _CUT * blur
    low_x = middle_x + grown * (both[:, 0].min() - middle_x) - reach
    high_x = middle_x + grown * (both[:, 0].max() - middle_x) + reach
    low_y = middle_y + grown * (both[:, 1].min() - middle_y) - reach
    high_y = middle_y + grown * (both[:, 1].max() - middle_y) + reach
    return (
        max(math.floor(low_y) - 1, 0),
        min(math.ceil(high_y) + 2, rows),
        max(math.floor(low_x) - 1, 0),
        min(math.ceil(high_x) + 2, columns),
    )


@njit(cache=True)
def draw_tags(
    canvas: NDArray[np.uint8],
    eye: Eye,
    prints: Prints,
    noise: NDArray[np.int8],
    noise_starts: NDArray[np.int64],
    placed: Placements,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Draw tags over an exposure.

    Args:
        canvas: (rows, columns) image that the tags are drawn over, noise already in it.
        eye: the camera.
        prints: the n tags.
        noise: (m,) grey levels, added to the tags' pixels.
        noise_starts: (n,) places in the noise.
        placed: where the tags are.

    Returns:
        True corners (n, 4, 2) px in the middle of the exposure; and whether any of a tag (n,) is in
        the picture.
    """
    tags = placed.counts.shape[0]
    corners, drawn = np.empty((tags, 4, 2)), np.empty(tags, dtype=np.bool_)
    both, maps = np.empty((8, 2)), np.empty((placed.instants.shape[1], 9))
    rows, columns = canvas.shape
    grown = prints.cells.shape[1] / prints.border
    for tag in range(tags):
        count = placed.counts[tag]
        _write_corners(eye, placed.middle[tag], corners[tag])
        _write_corners(eye, placed.instants[tag, 0], both[:4])
        _write_corners(eye, placed.instants[tag, count - 1], both[4:])
        box = _box_of(both, grown, eye.blur, rows, columns)
        drawn[tag] = box[0] < box[1] and box[2] < box[3]
        if not drawn[tag]:
            continue
        for k in range(count):
            _write_map(eye, placed.instants[tag, k], prints, maps[k])
        last = both[4:]
        side = math.hypot(last[1, 0] - last[0, 0], last[1, 1] - last[0, 1])
        side += math.hypot(last[2, 0] - last[3, 0], last[2, 1] - last[3, 1])
        other = math.hypot(last[3, 0] - last[0, 0], last[3, 1] - last[0, 1])
        other += math.hypot(last[2, 0] - last[1, 0], last[2, 1] - last[1, 1])
        wide = 2.0 * eye.blur * prints.border
        seen = Seen(maps[:count], wide / side, wide / other, prints.cells[tag])
        _draw_box(canvas, eye, noise, noise_starts[tag], box, seen)
    return corners, drawn
