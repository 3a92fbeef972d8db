"""Shapes of a limb, and where its tags are while it moves during an exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import CubicHermiteSpline

PLACEMENT = 5
"""Numbers of a placed tag: x, y, z [m], yaw [rad], size [m]."""

MOST_INSTANTS = 16
_STILL, _INSTANTS_APART = 0.2, 1.1
"""Ways during an exposure that are shorter than the first [px] are one instant; longer ones take
even instants, about so far apart [px]: of a blurred picture their mean is that of all, within a
grey level."""


@dataclass(frozen=True)
class Shape:
    """A centreline in the plane: arc length (n,) m, points (n, 2) m and heading (n,) rad."""

    arc_length: NDArray[np.float64]
    points: NDArray[np.float64]
    heading: NDArray[np.float64]

    def at(self, arc_length: ArrayLike) -> NDArray[np.float64]:
        """Return x, y, heading (…, 3) at arc lengths (…) (cubic), continued as a line beyond."""
        nodes = self.arc_length
        inside = np.clip(arc_length, nodes[0], nodes[-1])
        # The limb may be stretched: each chord is that of an arc.
        chords, turned = np.hypot(*np.diff(self.points, axis=0).T), np.diff(self.heading)
        along = np.append(0.0, np.cumsum(chords * (1.0 + turned**2 / 24.0)))
        curve = CubicHermiteSpline(along, self.points, _tangent(self.heading))
        heading = np.interp(inside, nodes, self.heading)
        place = curve(np.interp(inside, nodes, along))
        place += (np.asarray(arc_length) - inside)[..., None] * _tangent(heading)
        return np.concatenate([place, heading[..., None]], axis=-1)


def _tangent(heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit vectors (…, 2) of headings (…) rad."""
    return np.stack([np.cos(heading), np.sin(heading)], axis=-1)


def constant_curvature(
    lengths: Sequence[float], bends: Sequence[float], points: int = 121
) -> Shape:
    """Return a limb whose segments are arcs.

    Args:
        lengths: of the segments at rest [m].
        bends: angle each of them turns by [rad].
        points: of the whole centreline.
    """
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    arc_length = np.unique(np.concatenate([np.linspace(0.0, ends[-1], points), ends]))
    curvature = np.array(bends) / np.array(lengths)
    heading = np.zeros_like(arc_length)
    for k, bend in enumerate(curvature):
        heading += bend * np.clip(arc_length - ends[k], 0.0, lengths[k])
    return Shape(arc_length, _integrate(arc_length, heading), heading)


def _integrate(s: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate unit tangents exactly for a heading that is linear between the points."""
    step, turned = np.diff(s), np.diff(heading)
    middle = 0.5 * (heading[1:] + heading[:-1])
    chord = step * np.sinc(turned / (2.0 * np.pi))
    moves = chord[:, None] * _tangent(middle)
    return np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])


class Mounts(NamedTuple):
    """Where tags sit on a limb.

    Attributes:
        arc_length: (n,) m from the clamp.
        height: (n,) m above the base plane.
        size: (n,) m.
        offset: (n, 3) along and across the limb [m], and turn [rad].
    """

    arc_length: NDArray[np.float64]
    height: NDArray[np.float64]
    size: NDArray[np.float64]
    offset: NDArray[np.float64]

    def placed(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the placements (n, k, 5) of the tags where the centreline has poses (n, k, 3)."""
        tangent, (along, across, turn) = _tangent(poses[..., 2]), self.offset.T[:, :, None, None]
        result = np.empty((*poses.shape[:2], PLACEMENT))
        result[..., :2] = poses[..., :2] + along * tangent
        result[..., :2] += across * tangent[..., ::-1] * [-1.0, 1.0]
        result[..., 2] = self.height[:, None]
        result[..., 3] = poses[..., 2] + turn[..., 0]
        result[..., 4] = self.size[:, None]
        return result


class Placements(NamedTuple):
    """Where n tags are during an exposure.

    Attributes:
        middle: (n, 5) in the middle of it.
        instants: (n, MOST_INSTANTS, 5) at even instants.
        counts: (n,) how many of these instants count for each tag.
    """

    middle: NDArray[np.float64]
    instants: NDArray[np.float64]
    counts: NDArray[np.int64]


def place_tags(
    mounts: Mounts, exposure: float, scale: float, shape: Shape, velocity: Shape | None = None
) -> Placements:
    """Place the tags of a limb that moves during an exposure.

    Args:
        mounts: of the tags.
        exposure: time that the picture takes [s].
        scale: px that a metre takes in the picture.
        shape: the limb in the middle of it.
        velocity: its change in a second, in the same arrays; None: it rests.
    """
    middle = shape.at(mounts.arc_length)
    change = np.zeros_like(middle)
    if velocity is not None:
        points, heading = shape.points + velocity.points, shape.heading + velocity.heading
        change = Shape(shape.arc_length, points, heading).at(mounts.arc_length) - middle
    speed = np.hypot(change[:, 0], change[:, 1]) + np.abs(change[:, 2]) * mounts.size
    travelled = exposure * scale * speed
    steps = np.minimum(1.0 + np.ceil(travelled / _INSTANTS_APART), MOST_INSTANTS)
    counts = np.where(travelled < _STILL, 1, steps.astype(np.int64))
    middles = 2.0 * np.arange(MOST_INSTANTS) + 1.0
    times = 0.5 * exposure * (middles / counts[:, None] - 1.0)
    during = middle[:, None] + times[:, :, None] * change[:, None]
    return Placements(mounts.placed(middle[:, None])[:, 0], mounts.placed(during), counts)
