"""Shapes of a limb, and where its tags are while it moves during an exposure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

PLACEMENT = 5
"""Numbers of a placed tag: x, y, z [m], yaw [rad], size [m]."""

MOST_INSTANTS = 16
_STILL, _INSTANTS_APART = 0.2, 1.1
"""Ways during an exposure that are shorter than the first [px] are one instant; longer ones take
Gauss's instants, about so far apart [px]: of a blurred picture their mean is that of all."""


@dataclass(frozen=True)
class Shape:
    """A centreline in the plane: arc length (n,) m, points (n, 2) m and heading (n,) rad."""

    arc_length: NDArray[np.float64]
    points: NDArray[np.float64]
    heading: NDArray[np.float64]

    def at(self, arc_length: float) -> NDArray[np.float64]:
        """Return x, y, heading at an arc length (cubic), continued as a line beyond."""
        return np.array(place_at(self.arc_length, self.points, self.heading, arc_length))


def constant_curvature(
    lengths: Sequence[float], bends: Sequence[float], elongation: float = 1.0, points: int = 121
) -> Shape:
    """Return a limb whose segments are arcs.

    Args:
        lengths: of the segments at rest [m].
        bends: angle each of them turns by [rad].
        elongation: length over length at rest.
        points: of the whole centreline.
    """
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    arc_length = np.unique(np.concatenate([np.linspace(0.0, ends[-1], points), ends]))
    curvature = np.array(bends) / np.array(lengths)
    heading = np.zeros_like(arc_length)
    for k, bend in enumerate(curvature):
        heading += bend * np.clip(arc_length - ends[k], 0.0, lengths[k])
    return Shape(arc_length, elongation * _integrate(arc_length, heading), heading)


def _integrate(s: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate unit tangents exactly for a heading that is linear between the points."""
    step, turned = np.diff(s), np.diff(heading)
    middle = 0.5 * (heading[1:] + heading[:-1])
    chord = step * np.sinc(turned / (2.0 * np.pi))
    moves = chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
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


class Exposure(NamedTuple):
    """How a moving limb is seen.

    Attributes:
        half: of the time a picture takes [s].
        scale: px that a metre takes in the picture.
        instants: (MOST_INSTANTS, MOST_INSTANTS) Gauss's instants from -1 to 1, row k - 1 for k.
        shares: the same for the share of the exposure that each of them stands for.
    """

    half: float
    scale: float
    instants: NDArray[np.float64]
    shares: NDArray[np.float64]

    @classmethod
    def create(cls, time: float, scale: float) -> Exposure:
        """Return the exposure that takes a time [s] at a scale [px/m]."""
        instants, shares = np.zeros((2, MOST_INSTANTS, MOST_INSTANTS))
        for count in range(1, MOST_INSTANTS + 1):
            nodes, weights = np.polynomial.legendre.leggauss(count)
            instants[count - 1, :count], shares[count - 1, :count] = nodes, 0.5 * weights
        return cls(0.5 * time, scale, instants, shares)


@njit(cache=True)
def place_at(
    arc_length: NDArray[np.float64],
    points: NDArray[np.float64],
    heading: NDArray[np.float64],
    at: float,
) -> tuple[float, float, float]:
    """Return x, y, heading of a centreline at an arc length (cubic), beyond it of its tangent."""
    k = min(max(int(np.searchsorted(arc_length, at)) - 1, 0), len(arc_length) - 2)
    t = (at - arc_length[k]) / (arc_length[k + 1] - arc_length[k])
    if t < 0.0 or t > 1.0:
        end = 0 if t < 0.0 else len(arc_length) - 1
        reach, angle = at - arc_length[end], heading[end]
        x, y = points[end, 0] + reach * math.cos(angle), points[end, 1] + reach * math.sin(angle)
        return x, y, angle
    # Hermite: the tangents are known, their length is that of the chord's arc.
    turned = heading[k + 1] - heading[k]
    chord_x, chord_y = points[k + 1, 0] - points[k, 0], points[k + 1, 1] - points[k, 1]
    arc = math.hypot(chord_x, chord_y) * (1.0 + 0.25 * turned * turned / 6.0)
    along = 3.0 * t**2 - 2.0 * t**3
    first, second = arc * (t - 2.0 * t**2 + t**3), arc * (t**3 - t**2)
    x = points[k, 0] + along * chord_x
    x += first * math.cos(heading[k]) + second * math.cos(heading[k + 1])
    y = points[k, 1] + along * chord_y
    y += first * math.sin(heading[k]) + second * math.sin(heading[k + 1])
    return x, y, heading[k] + t * turned


@njit(cache=True)
def _write_placement(
    mounts: Mounts, tag: int, x: float, y: float, angle: float, placement: NDArray[np.float64]
) -> None:
    """Write the placement (5,) of a tag whose centreline is at x, y, angle."""
    offset, cosine, sine = mounts.offset[tag], math.cos(angle), math.sin(angle)
    placement[0] = x + cosine * offset[0] - sine * offset[1]
    placement[1] = y + sine * offset[0] + cosine * offset[1]
    placement[2] = mounts.height[tag]
    placement[3] = angle + offset[2]
    placement[4] = mounts.size[tag]


class Centreline(NamedTuple):
    """A limb in the middle of an exposure, and a second later at its present velocity.

    Attributes:
        arc_length: (m,) m.
        points: (m, 2) m.
        heading: (m,) rad.
        later_points: (m, 2) m.
        later_heading: (m,) rad.
    """

    arc_length: NDArray[np.float64]
    points: NDArray[np.float64]
    heading: NDArray[np.float64]
    later_points: NDArray[np.float64]
    later_heading: NDArray[np.float64]


class Placements(NamedTuple):
    """Where n tags are during an exposure.

    Attributes:
        middle: (n, 5) in the middle of it.
        instants: (n, MOST_INSTANTS, 5) at Gauss's instants.
        counts: (n,) how many instants there are for each tag.
    """

    middle: NDArray[np.float64]
    instants: NDArray[np.float64]
    counts: NDArray[np.int64]


@njit(cache=True)
def place_tags(mounts: Mounts, exposure: Exposure, limb: Centreline) -> Placements:
    """Place the tags of a limb that moves during an exposure."""
    tags = len(mounts.size)
    middle, counts = np.empty((tags, PLACEMENT)), np.empty(tags, dtype=np.int64)
    placements = np.empty((tags, MOST_INSTANTS, PLACEMENT))
    for tag in range(tags):
        at = mounts.arc_length[tag]
        x, y, angle = place_at(limb.arc_length, limb.points, limb.heading, at)
        _write_placement(mounts, tag, x, y, angle, middle[tag])
        later = place_at(limb.arc_length, limb.later_points, limb.later_heading, at)
        by_x, by_y, by_angle = later[0] - x, later[1] - y, later[2] - angle
        speed = math.hypot(by_x, by_y) + abs(by_angle) * mounts.size[tag]
        travelled = 2.0 * exposure.half * exposure.scale * speed
        if travelled < _STILL:
            counts[tag] = 1
            placements[tag, 0] = middle[tag]
            continue
        count = min(1 + math.ceil(travelled / _INSTANTS_APART), MOST_INSTANTS)
        counts[tag] = count
        for k in range(count):
            time = exposure.half * exposure.instants[count - 1, k]
            _write_placement(
                mounts, tag, x + time * by_x, y + time * by_y, angle + time * by_angle,
                placements[tag, k],
            )  # fmt: skip
    return Placements(middle, placements, counts)
