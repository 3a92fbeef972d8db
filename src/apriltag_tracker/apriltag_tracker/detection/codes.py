"""Read the code of a tag whose corners are known.

Cells are sampled at their centres, sharpened against their neighbours, and compared with a
threshold half-way between two planes: one through the white margin, one through the black border,
so that uneven light does not matter. A family with a white border is read in the negative.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from apriltag_tracker.family import Family

_SHARPENING = 0.25 * np.array([[[0.0, -1.0, 0.0], [-1.0, 4.0, -1.0], [0.0, -1.0, 0.0]]])
"""A quarter of the differences between a cell and its four neighbours is added to the cell."""

_LEAST_CONTRAST = 12.0
"""A tag whose margin is not brighter than its border by this is none [grey levels]."""

UNREADABLE = math.inf
"""The misfit of a quadrilateral that shows no tag."""


@functools.cache
def code_table(family: Family) -> NDArray[np.uint64]:
    """Return the codes of all printed tags in four directions as integers, (4, tags).

    Row r holds what is read when the corners start r corners late: at the printed lower right for
    r = 1, and so on counter-clockwise.
    """
    mask, codes = family.code_mask(), family.codes()
    cells = np.zeros((len(codes), *mask.shape), dtype=np.uint8)
    cells[:, mask] = 1 - codes if family.outer_ring else codes
    return np.array([_as_integers(np.rot90(cells, -turn, (1, 2))[:, mask]) for turn in range(4)])


def _as_integers(bits: NDArray[Any]) -> NDArray[np.uint64]:
    """Return rows of bits (n, count) as integers (n,), the first bit being the highest."""
    weights = np.uint64(1) << np.arange(bits.shape[1] - 1, -1, -1, dtype=np.uint64)
    return np.asarray((bits * weights).sum(axis=1, dtype=np.uint64))


def nearest_tag(code: np.uint64, family: Family) -> tuple[int, int, int]:
    """Return the tag nearest to a code, which corner is its printed lower left, and wrong cells."""
    wrong = np.bitwise_count(code_table(family) ^ code)
    turn, tag = divmod(int(np.argmin(wrong)), wrong.shape[1])
    return tag, (4 - turn) % 4, int(wrong[turn, tag])


class _Grid(NamedTuple):
    """The cells of a tag with its rim, row by row from the upper left.

    Attributes:
        border: (4, 2) where the corners of the border are in the grid [cells].
        places: (3, cells) homogeneous middles: column, row, 1.
        black: (cells,) whether a cell belongs to the border.
        through_black: (k, cells) from the brightness of the border's k cells to that of the plane
            through them.
        white: the same of the margin.
        through_white: the same of the margin.
        code: (cells,) whether a cell belongs to the code.
    """

    border: NDArray[np.float32]
    places: NDArray[np.float64]
    black: NDArray[np.bool_]
    through_black: NDArray[np.float64]
    white: NDArray[np.bool_]
    through_white: NDArray[np.float64]
    code: NDArray[np.bool_]


@functools.cache
def _grid(family: Family) -> _Grid:
    rings = family.rings().ravel()
    rows, columns = np.indices((family.tag_cells,) * 2).reshape(2, -1) + 0.5
    middle, one = 0.5 * family.tag_cells, np.ones_like(rows)
    low, high = family.rim, family.rim + family.border_cells
    planes = np.stack([one, rows - middle, columns - middle])

    def through(ring: NDArray[np.bool_]) -> NDArray[np.float64]:
        # The three are at right angles to each other on a ring.
        return np.asarray((planes[:, ring].T / np.sum(planes[:, ring] ** 2, axis=1)) @ planes)

    return _Grid(
        np.array([[low, high], [high, high], [high, low], [low, low]], dtype=np.float32),
        np.stack([columns, rows, one]),
        rings == 0,
        through(rings == 0),
        rings == -1,
        through(rings == -1),
        family.code_mask().ravel(),
    )


def _sample(
    image: NDArray[np.uint8], corners: NDArray[np.float64], grid: _Grid
) -> NDArray[np.float64]:
    """Return the brightness of n tags' cells, (n, cells); NaN if one is beyond the image."""
    quads = corners.astype(np.float32)
    maps = np.array([cv2.getPerspectiveTransform(grid.border, quad) for quad in quads])
    seen = maps.reshape(-1, 3, 3) @ grid.places
    places = seen[:, 1] / seen[:, 2], seen[:, 0] / seen[:, 2]
    values = ndimage.map_coordinates(image, places, np.float64, order=1, cval=np.nan)
    values[np.isnan(values).any(axis=1)] = np.nan
    return np.asarray(values)


def read_codes(
    image: NDArray[np.uint8], corners: NDArray[np.float64], family: Family
) -> tuple[NDArray[np.float64], NDArray[np.uint64]]:
    """Read the cells of codes as integers, upper left cell first.

    Args:
        image: grey image.
        corners: (n, 4, 2) px, counter-clockwise as printed; the first is taken for the lower left.
        family: of the tags.

    Returns:
        The misfit (n,): RMS distance of the cells from plain black and white, in half contrasts;
        `UNREADABLE` without a white margin, a black border and contrast. And the codes (n,).
    """
    grid = _grid(family)
    values = _sample(image, corners, grid)
    white = values[:, grid.white] @ grid.through_white
    black = values[:, grid.black] @ grid.through_black
    threshold, half = 0.5 * (white + black), 0.5 * np.mean(white - black, axis=1)
    bright = values > threshold
    # One cell of 14 of the border may be wrong.
    readable = bright[:, grid.black].sum(axis=1) <= 4 * (family.code_cells + 1) // 14
    readable &= 2.0 * half >= _LEAST_CONTRAST
    off = np.abs(values - threshold) / np.where(readable, half, 1.0)[:, None] - 1.0
    misfits = np.where(readable, np.sqrt(np.mean(off**2, axis=1)), UNREADABLE)
    pictures = values.reshape(-1, family.tag_cells, family.tag_cells)
    sharp = values + ndimage.convolve(pictures, _SHARPENING, mode="nearest").reshape(values.shape)
    return misfits, _as_integers((sharp > threshold)[:, grid.code])
