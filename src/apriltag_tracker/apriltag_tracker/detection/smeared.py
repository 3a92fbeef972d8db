"""Read the code of a tag that moved by more than a cell during the exposure.

A smear is linear: what a point of the picture shows is the mean of the cells that passed it. For a
smear of known direction and length, the cells' grey levels follow from samples of the picture by
least squares. A table of such solutions for smears of all directions is tried; how well each of
them explains the samples tells which smear it was, and the printed code nearest to its cells which
tag. That it is this tag is for the fit of the whole pattern to say.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.detection import decoding
from apriltag_tracker.detection.edges import inside, sample
from apriltag_tracker.family import Family, Layout

_DIRECTIONS = 10
_LENGTHS = (1.0, 1.5, 2.0, 2.5)
"""Of the smears that are tried [cells]."""

_SPACING = 0.5
_FIRST = -0.75
"""Samples lie in this raster [cells], from so far outside of the border."""

_FAR = 2
"""No sample is so far outside of a tag, nor was during the smear [cells]."""

_RIDGE = 0.02
_TRIED = 8
"""Of the smears that explain the samples best."""

_LEAST_EXPLAINED = 0.8
_LEAST_CONTRAST = 12.0


@dataclass(frozen=True)
class SmearedCode:
    """What a smeared quadrilateral may be.

    Attributes:
        id: of the tag whose code is nearest.
        turn: which corner is its printed lower left.
        smear: (2,) px, the way during the exposure.
    """

    id: int
    turn: int
    smear: NDArray[np.float64]


@dataclass(frozen=True)
class _Table:
    """Smears (h, 2) in cells, and of each solution (n, samples) and normal matrix (n, n)."""

    smears: NDArray[np.float64]
    solutions: NDArray[np.float32]
    normals: NDArray[np.float32]


def _raster(layout: Layout) -> NDArray[np.float64]:
    """Return where samples lie along one side [cells]; an outer ring is sampled, too."""
    code_cells, outer = layout
    first = _FIRST - outer
    return np.arange(first, code_cells + 2 - first + 1e-9, _SPACING)


def _unknowns(family: Family) -> NDArray[np.int64]:
    """Return which unknown each cell is, upper row first, of a tag and `_FAR` cells around it.

    The grey levels of the cells of the code come first, then those of the border and the margin,
    and of what is beyond an outer ring.
    """
    mask = family.code_mask()
    bits = int(mask.sum())
    number = np.full(mask.shape, bits + 1)
    border = np.s_[family.rim : -family.rim]
    number[border, border] = bits
    number[mask] = np.arange(bits)
    return np.pad(number, _FAR, constant_values=bits + 1 + int(family.outer_ring))


@functools.cache
def _table(family: Family) -> _Table:
    """Return the solutions for all smears."""
    cells = _unknowns(family)
    count = int(cells.max()) + 1
    left, bottom = family.rim + _FAR, family.rim + _FAR + family.border_cells - 1
    places = _raster(family.layout)
    across, up = np.meshgrid(places, places)
    smears, shown = [], []
    instants = (np.arange(15) + 0.5) / 15 - 0.5
    for length in _LENGTHS:
        for k in range(_DIRECTIONS):
            angle = math.pi * k / _DIRECTIONS
            smear = length * np.array([math.cos(angle), math.sin(angle)])
            design = np.zeros((across.size, count))
            for t in instants:
                column = left + np.floor(across + t * smear[0]).astype(np.int64).ravel()
                row = bottom - np.floor(up + t * smear[1]).astype(np.int64).ravel()
                design[np.arange(across.size), cells[row, column]] += 1.0 / len(instants)
            smears.append(smear)
            shown.append(design)
    stacked = np.array(shown)
    normal = np.swapaxes(stacked, 1, 2) @ stacked + _RIDGE * np.eye(count)
    solutions = np.linalg.solve(normal, np.swapaxes(stacked, 1, 2))
    return _Table(np.array(smears), solutions.astype(np.float32), normal.astype(np.float32))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _sample_quad(
    image: NDArray[np.uint8],
    corners: NDArray[np.float64],
    places: NDArray[np.float64],
    values: NDArray[np.float64],
) -> bool:
    """Sample a quadrilateral at `places` [cells] along both sides, upwards and to the right."""
    h = decoding.square_to_quad(corners)
    # Places are as far outside on one side as on the other.
    border = places[0] + places[-1]
    for row in range(len(places)):
        v = places[row] / border
        for column in range(len(places)):
            u = places[column] / border
            w = h[6] * u + h[7] * v + 1.0
            x, y = (h[0] * u + h[1] * v + h[2]) / w, (h[3] * u + h[4] * v + h[5]) / w
            if not inside(image, x, y):
                return False
            values[row * len(places) + column] = sample(image, x, y)
    return True


def read_smeared(
    image: NDArray[np.uint8], quad: NDArray[np.float64], family: Family
) -> SmearedCode | None:
    """Read a quadrilateral (4, 2) px that runs as printed; None if it is no smeared tag."""
    bits = family.codes().shape[1]
    table, places = _table(family), _raster(family.layout)
    values = np.empty(len(places) ** 2)
    if not _sample_quad(image, quad, places, values):
        return None
    values = (values - values.mean()).astype(np.float32)
    whole = max(float(values @ values), 1e-3)
    levels = table.solutions @ values
    # Of a least-squares solution x with normal matrix N, xᵀ N x is what it explains.
    explained = np.einsum("hc,hcd,hd->h", levels, table.normals, levels) / whole
    if explained.max() < _LEAST_EXPLAINED:
        return None
    best: SmearedCode | None = None
    fewest = family.most_wrong + 1
    for k in np.argsort(-explained)[:_TRIED]:
        black, white = levels[k, bits : bits + 2]
        if white - black < _LEAST_CONTRAST:
            continue
        tag, turn, wrong = decoding.nearest_code(levels[k, :bits] > 0.5 * (black + white), family)
        if wrong < fewest:
            side = 0.5 * (quad[1] - quad[0] + quad[2] - quad[3]) / family.border_cells
            rise = 0.5 * (quad[3] - quad[0] + quad[2] - quad[1]) / family.border_cells
            smear = table.smears[k, 0] * side + table.smears[k, 1] * rise
            best, fewest = SmearedCode(tag, turn, smear), wrong
    return best
