"""How fast a course of bend angles may be gone through."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

from der_planner.arrays import Array
from der_planner.planning.paths import PathLimits, evenly_in_time, keep_acceleration
from der_planner.planning.workspace import Workspace

SLEW_SHARE = 0.8
"""Share of the slew limit for changing the static pressures; the rest is for the inertia."""
RISE = 0.5
"""Time in which bend angles reach their greatest rate [s]."""
_GRID = 0.02
"""Time between two samples of a course that keeps its times [s]."""


def retimed(
    workspace: Workspace,
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
        workspace: of the limb.
        course: bend angles [rad] by a parameter [s].
        span: the parameter goes from 0 to this.
        limits: speed and acceleration of the tip.
        rest: begin and end at rest even without limits.

    Raises:
        PlanningError: it would last too long.
    """
    count = int(np.clip(span / 0.01, 200, 40000))
    place = np.linspace(0.0, span, count)
    rate, greatest = _rates(workspace, course, place, limits)
    if limits is None and not rest and np.all(rate >= 1.0):
        samples = max(20, round(span / _GRID) + 1)
        return np.linspace(0.0, span, samples), np.linspace(0.0, span, samples)
    if limits is not None or rest:
        rate[0] = rate[-1] = 0.0
    step = float(place[1])
    keep_acceleration(rate, 2 * np.minimum(greatest[1:], greatest[:-1]) * step)
    time, along = evenly_in_time(2 * step / np.maximum(rate[1:] + rate[:-1], 1e-6), place)
    return time, np.clip(along, 0.0, span)


def _rates(
    workspace: Workspace,
    course: PchipInterpolator,
    place: Array,
    limits: PathLimits | None,
) -> tuple[Array, Array]:
    """Return the largest rate of the parameter [1] and of its rate [1/s] at places (K,)."""
    fastest = SLEW_SHARE * workspace.fastest
    bend, turn = np.abs(course(place, 1)), np.abs(course(place, 2))
    tiny = 1e-9
    rate = (fastest / np.maximum(bend, tiny)).min(axis=1)
    rate = np.minimum(rate, np.sqrt(fastest / RISE / np.maximum(turn, tiny)).min(axis=1))
    greatest = (fastest / RISE / np.maximum(bend, tiny)).min(axis=1)
    if limits is None:
        return np.minimum(rate, 1.0), greatest
    tip = workspace.arcs.tip(course(place))
    first = np.gradient(tip, place, axis=0)
    second = np.linalg.norm(np.gradient(first, place, axis=0), axis=1)
    speed = np.maximum(np.linalg.norm(first, axis=1), tiny)
    rate = np.minimum(rate, limits.speed / speed)
    rate = np.minimum(rate, np.sqrt(limits.acceleration / np.maximum(second, tiny)))
    return rate, np.minimum(greatest, limits.acceleration / speed)
