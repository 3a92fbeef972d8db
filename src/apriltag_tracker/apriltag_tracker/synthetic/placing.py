"""Where the tags of a moving limb are during an exposure, compiled."""

from __future__ import annotations

import math
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


@njit(cache=True)
def place_tags(
    mounts: Mounts,
    exposure: Exposure,
    arc_length: NDArray[np.float64],
    points: NDArray[np.float64],
    heading: NDArray[np.float64],
    later_points: NDArray[np.float64],
    later_heading: NDArray[np.float64],
    middle: NDArray[np.float64],
    placements: NDArray[np.float64],
    counts: NDArray[np.int64],
) -> None:
    """Place the tags of a limb.

    Args:
        mounts: where they sit on it.
        exposure: during which they move.
        arc_length: (m,) m, of the limb's centreline.
        points: (m, 2) m, in the middle of the exposure.
        heading: (m,) rad, the same.
        later_points: (m, 2) m, a second later at the present velocity.
        later_heading: (m,) rad, the same.
        middle: (n, 5) output, placements in the middle of the exposure.
        placements: (n, MOST_INSTANTS, 5) output, placements at Gauss's instants of the exposure.
        counts: (n,) output, how many instants there are for each tag.
    """
    for tag in range(len(mounts.size)):
        at = mounts.arc_length[tag]
        x, y, angle = place_at(arc_length, points, heading, at)
        _write_placement(mounts, tag, x, y, angle, middle[tag])
        next_x, next_y, next_angle = place_at(arc_length, later_points, later_heading, at)
        by_x, by_y, by_angle = next_x - x, next_y - y, next_angle - angle
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
