"""Regions of a picture put together into one, so that one search covers them all."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

_TILE = 16
"""Tiles of the mosaic are padded to a multiple of this [px]."""


def mosaic_of(
    image: NDArray[np.uint8], boxes: Sequence[tuple[int, int, int, int]]
) -> tuple[NDArray[np.uint8], list[tuple[int, int]]]:
    """Put regions of an image side by side; returns the mosaic and each tile's row and column."""
    side = max(max(bottom - top, right - left) for top, bottom, left, right in boxes)
    tile = -(-(side + 4) // _TILE) * _TILE
    across = int(np.ceil(np.sqrt(len(boxes))))
    down = -(-len(boxes) // across)
    mosaic = np.full((down * tile, across * tile), 128, dtype=np.uint8)
    corners = []
    for k, (top, bottom, left, right) in enumerate(boxes):
        row, column = (k // across) * tile, (k % across) * tile
        mosaic[row : row + bottom - top, column : column + right - left] = image[
            top:bottom, left:right
        ]
        corners.append((row, column))
    return mosaic, corners


def from_mosaic(
    quads: NDArray[np.float64],
    boxes: Sequence[tuple[int, int, int, int]],
    corners: Sequence[tuple[int, int]],
) -> NDArray[np.float64]:
    """Return corners (n, 4, 2) of the mosaic as corners in the image."""
    result = quads.copy()
    starts = np.array(corners, dtype=float)
    for i, quad in enumerate(quads):
        middle = quad.mean(axis=0)
        gaps = middle[::-1] - starts
        inside = np.where((gaps >= 0).all(axis=1), gaps.sum(axis=1), np.inf)
        k = int(np.argmin(inside))
        top, _, left, _ = boxes[k]
        result[i] += (left - corners[k][1], top - corners[k][0])
    return result


def sharpened(image: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    """Enlarge an image and sharpen it, which brings back tags that motion has smeared."""
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(large, (0, 0), 1.5 * scale)
    result: NDArray[np.uint8] = cv2.addWeighted(large, 2.2, soft, -1.2, 0.0)
    return result
