"""Where `limb_base` is in the frame of the poses, and the plane in which the limb moves."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BaseFrame, BodyMap

Array = NDArray[np.float64]

_MEMORY = 50
"""Frames over which fixed bodies are averaged, and after which the base follows if all of them were
moved."""
_ARM = 0.05
"""Distance of the points that stand for the axes of a body whose rotation is known [m]."""
_MISFIT = 0.003
"""RMS distance at which fixed bodies do not fit together [m]."""
_LEAST_SPREAD = 0.005
"""Points that are nearer to a line than this tell no frame [m]."""
_LEAST_MOTION = 0.003
"""RMS way across its main direction that a limb must move to show its plane [m]."""


def fit_frame(points: Array, places: Array) -> tuple[BaseFrame, float] | None:
    """Find the motion that brings points onto places best (Kabsch 1976).

    Args:
        points: (n, 3) m in one frame.
        places: (n, 3) m in the other.

    Returns:
        The frame and the RMS distance that is left [m]; None if the points lie on a line.
    """
    if len(points) < 3:
        return None
    middle, centre = points.mean(axis=0), places.mean(axis=0)
    root = math.sqrt(len(points))
    if np.linalg.svd(points - middle, compute_uv=False)[1] < _LEAST_SPREAD * root:
        return None
    turn, left = Rotation.align_vectors(places - centre, points - middle)
    rotation = turn.as_matrix()
    return BaseFrame(rotation, centre - rotation @ middle), left / root


class BaseFinder:
    """Keeps where `limb_base` is: from fixed bodies, averaged, or as the map says.

    Args:
        bodies: the body map.
    """

    def __init__(self, bodies: BodyMap) -> None:
        self._index = [bodies.names.index(body.name) for body in bodies.fixed]
        self._turned = np.array([body.rotation is not None for body in bodies.fixed], dtype=bool)
        axes = [np.eye(3) if body.rotation is None else body.rotation for body in bodies.fixed]
        places = np.array([body.position for body in bodies.fixed]).reshape(-1, 3)
        self._places = _arms(places, np.array(axes).reshape(-1, 3, 3))
        self._mean, self._seen = np.zeros_like(self._places), np.zeros(len(self._index))
        self._given = self.frame = bodies.frame
        self.residual = math.nan
        """RMS distance of the fixed bodies from where the map has them [m]."""
        self.problem = "" if bodies.frame else "no fixed body has been seen yet"

    def update(self, positions: Array, rotations: Array) -> BaseFrame | None:
        """Take one frame of all bodies and return the base to use for it, None without one.

        Args:
            positions: (n, 3) m, in the order of the map's names; NaN for what was not seen.
            rotations: (n, 3, 3) the bodies' axes, as columns.
        """
        points = _arms(positions[self._index], rotations[self._index])
        seen = np.isfinite(points[:, 0, 0])
        if self._given is not None or not seen.any():
            return self.frame
        self._seen[seen] = np.minimum(self._seen[seen] + 1, _MEMORY)
        share = 1.0 / self._seen[seen, None, None]
        self._mean[seen] += share * (points[seen] - self._mean[seen])
        # The ends of the axes count where the map says how a body is turned.
        used = (self._seen > 0)[:, None] & (self._turned[:, None] | (np.arange(4) == 0))
        found = fit_frame(self._mean[used], self._places[used])
        self.frame = None
        if found is None:
            self.problem = (
                "the fixed bodies that are seen tell no frame: three off a line are needed"
            )
        elif found[1] > _MISFIT:
            apart = f"{1e3 * found[1]:.0f} mm: check their positions, names and length_unit"
            self.problem = f"the fixed bodies do not fit together, {apart}"
        else:
            (self.frame, self.residual), self.problem = found, ""
        return self.frame


def _arms(positions: Array, rotations: Array) -> Array:
    """Return the origins of bodies and the ends of their axes, (n, 4, 3)."""
    ends = positions[:, None] + _ARM * rotations.swapaxes(1, 2)
    return np.concatenate([positions[:, None], ends], axis=1)


class PlaneWatch:
    """Finds the plane in which a limb moves, from where its bodies were so far.

    Args:
        heights: (n,) of the bodies above the centreline's plane, as the map says [m].
    """

    def __init__(self, heights: Array) -> None:
        self._heights = heights
        self._count = 0
        self._sum, self._squares = np.zeros(3), np.zeros((3, 3))

    def take(self, places: Array) -> None:
        """Take the places (n, 3) [m] of one frame; NaN for what was not seen."""
        seen = np.isfinite(places).all(axis=1)
        points = places[seen] - self._heights[seen, None] * [0.0, 0.0, 1.0]
        self._count += len(points)
        self._sum += points.sum(axis=0)
        self._squares += points.T @ points

    def values(self) -> dict[str, object]:
        """Return what to tell of it: its tilt against `limb_base`, how far bodies leave it."""
        mean = self._sum / max(self._count, 1)
        spread = self._squares / max(self._count, 1) - np.outer(mean, mean)
        squares, axes = np.linalg.eigh(spread)
        out, across = np.sqrt(np.maximum(squares[:2], 0.0))
        if across < max(_LEAST_MOTION, 3.0 * out):
            return {"plane": "the limb has not moved enough to show its plane"}
        normal = axes[:, 0] * np.copysign(1.0, axes[2, 0])
        return {
            "plane_tilt_deg": f"{math.degrees(math.acos(min(1.0, normal[2]))):.2f}",
            "plane_tilt_toward_deg": f"{math.degrees(math.atan2(normal[1], normal[0])):.0f}",
            "out_of_plane_mm_rms": f"{1e3 * out:.2f}",
        }
