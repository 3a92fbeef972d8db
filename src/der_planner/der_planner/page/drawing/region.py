"""The region that a tip reaches, as polygons to shade."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.model import ArcModel
from der_planner.planning import Workspace

Array = NDArray[np.float64]

_CELLS = 500
"""Pixels along the longer side of the picture in which the region is drawn."""
_POSES = 40_000


def reachable_region(limb: Limb) -> list[Array]:
    """Return the outlines (P, 2) [m] of what the tip of constant-curvature arcs reaches.

    The bend angles within the pressure limit are cut into small cells; the tips of each cell's
    corners are filled in a picture, whose outlines are returned. They are right to a five-hundredth
    of the region's size. Weight that bends the limb counts as `static_pressure` does.

    Args:
        limb: for its arcs and pressure limit.
    """
    count = limb.segment_count
    space = Workspace(ArcModel(limb))
    size = max(4, round(_POSES ** (1 / max(count, 2))))
    axes = [np.linspace(a, b, size) for a, b in zip(space.low, space.high, strict=True)]
    poses = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    tips = space.arcs.tip(poses)
    limit = limb.pneumatics.pressure_limit * (1 + 1e-9)
    held: NDArray[np.bool_] = np.all(np.abs(space.static_pressure(poses)) <= limit, axis=-1)
    if not held.any():
        return []
    corner = tips[held].min(axis=0)
    cell = max(float(np.ptp(tips[held], axis=0).max()) / _CELLS, 1e-6)
    pixels = np.round((tips - corner) / cell).astype(np.int32) + 2
    width, height = pixels[held].max(axis=0) + 3
    picture = np.zeros((height, width), np.uint8)
    for face in _faces(pixels, held):
        cv2.fillConvexPoly(picture, cv2.convexHull(face), 255)
    # Between the cells' own roundings.
    picture = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    outlines, _ = cv2.findContours(picture, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    smooth = [cv2.approxPolyDP(outline, 0.7, closed=True) for outline in outlines]
    return [(line[:, 0] - 2.0) * cell + corner for line in smooth if len(line) > 2]


def _faces(pixels: NDArray[np.int32], held: NDArray[np.bool_]) -> list[NDArray[np.int32]]:
    """Return the corners (4, 2) of each face of the grid of poses whose corners are all held."""
    count = held.ndim
    if count == 1:
        return [pixels[k : k + 2] for k in range(len(pixels) - 1)]
    found = []
    for first in range(count):
        for second in range(first + 1, count):
            turned = np.moveaxis(pixels, (first, second), (0, 1))
            ok = np.moveaxis(held, (first, second), (0, 1))
            good = ok[:-1, :-1] & ok[1:, :-1] & ok[1:, 1:] & ok[:-1, 1:]
            parts = (turned[:-1, :-1], turned[1:, :-1], turned[1:, 1:], turned[:-1, 1:])
            found.append(np.stack([part[good] for part in parts], axis=1))
    return list(np.concatenate(found))
