"""Images of tags in closed form: no texture is sampled, so corners are where they should be.

A pixel sees the printed pattern through a Gaussian, the lens's blur together with the pixel's own
area. Seen from the tag, this is a product of two error functions per cell, exact for a tag that is
not foreshortened much. Each pixel's ray comes from the exact inverse of the lens distortion.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

PIXEL_VARIANCE = 1.0 / 12.0
"""Of a box of one pixel [px²]."""

_TABLE_STEPS = 1024
_TABLE_REACH = 3.5


def cumulative_table() -> NDArray[np.float32]:
    """Return the Gaussian's cumulative distribution from −3.5 to 3.5 standard deviations."""
    grid = np.linspace(-_TABLE_REACH, _TABLE_REACH, _TABLE_STEPS + 1)
    return np.array([0.5 * (1.0 + math.erf(x / math.sqrt(2.0))) for x in grid], dtype=np.float32)


@njit(cache=True, fastmath=True)  # type: ignore[untyped-decorator]
def _cumulative(x: float, table: NDArray[np.float32]) -> float:
    if x <= -_TABLE_REACH:
        return 0.0
    if x >= _TABLE_REACH:
        return 1.0
    place = (x + _TABLE_REACH) * (_TABLE_STEPS / (2.0 * _TABLE_REACH))
    k = int(place)
    part = place - k
    return float(table[k] * (1.0 - part) + table[min(k + 1, _TABLE_STEPS)] * part)


@njit(cache=True, fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _seen(
    m: NDArray[np.float64],
    x: float,
    y: float,
    spread: NDArray[np.float64],
    cells: NDArray[np.uint8],
    weights: NDArray[np.float64],
    table: NDArray[np.float32],
) -> tuple[float, float]:
    """Return which share of a pixel sees the tag, and which its white cells, at one instant.

    `weights` (n,) is room to work in; the rest is as in `draw_tag`.
    """
    count = cells.shape[0]
    scale = 1.0 / (m[2, 0] * x + m[2, 1] * y + m[2, 2])
    u = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) * scale
    v = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) * scale
    u0 = max(math.floor(u - 3.0 * spread[0]), 0)
    u1 = min(math.floor(u + 3.0 * spread[0]), count - 1)
    v0 = max(math.floor(v - 3.0 * spread[1]), 0)
    v1 = min(math.floor(v + 3.0 * spread[1]), count - 1)
    if u0 > u1 or v0 > v1:
        return 0.0, 0.0
    across, down = 1.0 / spread[0], 1.0 / spread[1]
    last = _cumulative((u0 - u) * across, table)
    for i in range(u0, u1 + 1):
        following = _cumulative((i + 1 - u) * across, table)
        weights[i] = following - last
        last = following
    cover, bright = 0.0, 0.0
    last = _cumulative((v0 - v) * down, table)
    for j in range(v0, v1 + 1):
        following = _cumulative((j + 1 - v) * down, table)
        share = following - last
        last = following
        for i in range(u0, u1 + 1):
            cover += share * weights[i]
            bright += share * weights[i] * cells[j, i]
    return cover, bright


@njit(cache=True, fastmath=True, error_model="numpy")  # type: ignore[untyped-decorator]
def draw_tag(
    canvas: NDArray[np.uint8],
    rays: NDArray[np.float32],
    light: NDArray[np.float32],
    noise: NDArray[np.int8],
    noise_start: int,
    box: NDArray[np.int64],
    maps: NDArray[np.float64],
    shares: NDArray[np.float64],
    spread: NDArray[np.float64],
    cells: NDArray[np.uint8],
    black: float,
    white: float,
    table: NDArray[np.float32],
) -> None:
    """Draw one tag into its bounding box.

    Args:
        canvas: (rows, columns) image that the tag is drawn over, noise already in it.
        rays: (rows, columns, 2) normalised coordinates of the pixels.
        light: (rows, columns) brightness of the light, 1 is nominal.
        noise: (n,) grey levels, added to the tag's pixels from `noise_start` on.
        noise_start: place in the noise.
        box: first row, end row, first column, end column.
        maps: (k, 3, 3) from rays to cells (column to the right, row downward), one for each instant
            of the exposure.
        shares: (k,) of the exposure that each instant stands for; they sum to 1.
        spread: (2,) standard deviation of blur and pixel in cells, along columns and rows.
        cells: (n, n) printed cells with their margin, 1 is white.
        black: grey level of black cells in nominal light.
        white: grey level of white cells in nominal light.
        table: of `cumulative_table`.
    """
    instants = maps.shape[0]
    weights = np.empty(cells.shape[0])
    position = noise_start
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            x, y = rays[row, column, 0], rays[row, column, 1]
            cover, bright = 0.0, 0.0
            for k in range(instants):
                more, whiter = _seen(maps[k], x, y, spread, cells, weights, table)
                cover += shares[k] * more
                bright += shares[k] * whiter
            if cover <= 0.0:
                continue
            value = (black * (cover - bright) + white * bright) * light[row, column]
            value += noise[position % noise.shape[0]] * cover
            position += 1
            value += (1.0 - cover) * canvas[row, column]
            canvas[row, column] = int(min(max(value + 0.5, 0.0), 255.0))
