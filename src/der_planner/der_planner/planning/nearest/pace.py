"""How fast a course of bend angles may be gone through."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from der_planner.limb import Limb
from der_planner.model.bending import Kinematics
from der_planner.planning.errors import PlanningError
from der_planner.planning.paths import LONGEST, PathLimits, running_mean

Array = NDArray[np.float64]

SLEW_SHARE = 0.8
"""Of the slew limit, for changing the static pressures; the rest is for the limb's inertia."""
RISE = 0.5
"""[s] in which bend angles reach their greatest rate."""
_SOFTNESS = 0.2
"""Half width of the mean that rounds the corners of a speed profile [s]."""
_GRID = 0.02


def retimed(
    limb: Limb,
    kinematics: Kinematics,
    course: PchipInterpolator,
    span: float,
    limits: PathLimits | None,
    rest: bool = False,
) -> tuple[Array, Array]:
    """Return instants (K,) [s], from 0, and where along a course (K,) the limb is then.

    The course is kept; what changes is when each of its points comes. With ``limits`` it is gone
    through as fast as they and the slew limit allow, from rest to rest. Without, its own parameter
    is the time, and it is slowed where the slew limit asks for it.

    Args:
        limb: for its slew limit.
        kinematics: of arcs.
        course: bend angles [rad] by a parameter [s].
        span: the parameter goes from 0 to this.
        limits: speed and acceleration of the tip.
        rest: begin and end at rest even without limits.

    Raises:
        PlanningError: it would last too long.
    """
    count = int(np.clip(span / 0.01, 200, 40000))
    place = np.linspace(0.0, span, count)
    rate, greatest = _rates(limb, kinematics, course, place, limits)
    if limits is None and not rest and np.all(rate >= 1.0):
        samples = max(20, round(span / _GRID) + 1)
        return np.linspace(0.0, span, samples), np.linspace(0.0, span, samples)
    if limits is not None or rest:
        rate[0] = rate[-1] = 0.0
    _keep_acceleration(rate, greatest, float(place[1]))
    durations = 2 * place[1] / np.maximum(rate[1:] + rate[:-1], 1e-6)
    time = np.concatenate([[0.0], np.cumsum(durations)])
    if time[-1] > LONGEST:
        raise PlanningError(
            f"the path would last {time[-1]:.0f} s, the longest is {LONGEST:.0f} s: draw less, or "
            "allow a higher speed"
        )
    grid = np.linspace(0.0, time[-1], max(20, round(time[-1] / _GRID) + 1))
    along = PchipInterpolator(time, place)(grid)
    along = running_mean(along, window=max(1, round(_SOFTNESS / float(grid[1]))))
    return np.arange(len(along), dtype=np.float64) * grid[1], np.clip(along, 0.0, span)


def _rates(
    limb: Limb,
    kinematics: Kinematics,
    course: PchipInterpolator,
    place: Array,
    limits: PathLimits | None,
) -> tuple[Array, Array]:
    """Return the largest rate of the parameter [1] and of its rate [1/s] at places (K,)."""
    fastest = SLEW_SHARE * limb.pneumatics.slew_limit * limb.static_gain
    bend, turn = np.abs(course(place, 1)), np.abs(course(place, 2))
    tiny = 1e-9
    rate = (fastest / np.maximum(bend, tiny)).min(axis=1)
    rate = np.minimum(rate, np.sqrt(fastest / RISE / np.maximum(turn, tiny)).min(axis=1))
    greatest = (fastest / RISE / np.maximum(bend, tiny)).min(axis=1)
    if limits is None:
        return np.minimum(rate, 1.0), greatest
    tip = kinematics.tip(course(place))
    first = np.gradient(tip, place, axis=0)
    second = np.linalg.norm(np.gradient(first, place, axis=0), axis=1)
    speed = np.maximum(np.linalg.norm(first, axis=1), tiny)
    rate = np.minimum(rate, limits.speed / speed)
    rate = np.minimum(rate, np.sqrt(limits.acceleration / np.maximum(second, tiny)))
    return rate, np.minimum(greatest, limits.acceleration / speed)


def _keep_acceleration(rate: Array, greatest: Array, step: float) -> None:
    """Lower the rates (K,) until none changes faster than it may, forward and backward."""
    gain = 2 * np.minimum(greatest[1:], greatest[:-1]) * step
    for k in range(len(gain)):
        rate[k + 1] = min(rate[k + 1], math.sqrt(rate[k] ** 2 + gain[k]))
    for k in range(len(gain) - 1, -1, -1):
        rate[k] = min(rate[k], math.sqrt(rate[k + 1] ** 2 + gain[k]))
