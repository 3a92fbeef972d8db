"""When a motion is where: transitions between poses, and how fast a course is gone through.

Transitions are quintics from rest to a motion, from one to another, and back to rest: sequences of
bend angles (K, M) [rad] on a fine grid of instants. `resting_spline` turns the whole of them into a
function that can be differentiated twice. `retimed` finds the times of a course from its limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BPoly, BSpline, PchipInterpolator, make_interp_spline
from scipy.ndimage import uniform_filter1d

from der_planner.arrays import Array
from der_planner.model import CONTROL_PERIOD
from der_planner.planning.loads import PlanningError
from der_planner.planning.workspace import Workspace

FINE_PERIOD = 0.01
"""Time between two samples of a transition, about [s]."""
LONGEST = 3600.0
"""Longest duration of a motion [s]."""
_GRID = 0.02
"""Time between two samples of a path that gets its timing from limits [s]."""
_SOFTNESS = 0.2
"""Half width of the mean that rounds the corners of a speed profile [s]."""
_TINY = 1e-9
"""Rates are divided by this at least [rad/s], [m/s]."""
SLEW_SHARE = 0.8
"""Share of the slew limit for changing the static pressures; the rest is for the inertia."""
RISE = 0.5
"""Time in which bend angles reach their greatest rate [s]."""


Moving = tuple[Array, Array, Array]
"""Bend angles (M,) [rad], their rates [rad/s] and accelerations [rad/s²]."""


@dataclass(frozen=True)
class PathLimits:
    """How fast the tip may go along a path that comes without times.

    Attributes:
        speed: [m/s].
        acceleration: along and across the path [m/s²].
    """

    speed: float = 0.03
    acceleration: float = 0.05


@dataclass(frozen=True)
class Start:
    """Where a motion begins, if not at rest: where another one is left.

    Attributes:
        bend_angles: (M,) of the arcs [rad].
        rate: (M,) [rad/s].
        acceleration: (M,) [rad/s²].
        pressure: (M,) command in force [Pa].
    """

    bend_angles: Array
    rate: Array
    acceleration: Array
    pressure: Array


def sample_spline(spline: BSpline, time: ArrayLike) -> tuple[Array, Array, Array]:
    """Return value, rate and acceleration of a spline; beyond its ends it rests."""
    instants = np.asarray(time, dtype=float)
    first, last = spline.t[spline.k], spline.t[-spline.k - 1]
    inside = ((instants >= first) & (instants <= last))[..., None]
    clipped = np.clip(instants, first, last)
    value: Array = spline(clipped)
    return (
        value,
        np.where(inside, spline(clipped, 1), 0.0),
        np.where(inside, spline(clipped, 2), 0.0),
    )


def resting_spline(time: ArrayLike, values: ArrayLike, start: Start | None = None) -> BSpline:
    """Return the quintic spline through (K, M) values that ends at rest and starts as given."""
    samples = np.asarray(values, dtype=float)
    rest = np.zeros(samples.shape[1:])
    begin = (rest, rest) if start is None else (start.rate, start.acceleration)
    ends: Any = ([(1, begin[0]), (2, begin[1])], [(1, rest), (2, rest)])
    return make_interp_spline(np.asarray(time), samples, k=5, bc_type=ends)


def with_transitions(
    fastest: Array, time: Array, angles: Array, home: Array
) -> tuple[Array, Array]:
    """Return times and angles that begin and end at rest at home.

    Args:
        fastest: (M,) rates of the bend angles at the slew limit [rad/s].
        time: (K,) [s].
        angles: (K, M) of the motion [rad].
        home: (M,) where the limb rests [rad].
    """
    inner = make_interp_spline(time, angles, k=5)
    first, last = ((inner(t), inner(t, 1), inner(t, 2)) for t in (time[0], time[-1]))
    between = fine_grid(on_grid(time[-1] - time[0]))
    middle = between, inner(np.minimum(time[0] + between, time[-1]))
    rest = at_rest(home)
    approach, back = _transition(fastest, rest, first), _transition(fastest, last, rest)
    return in_turn(in_turn(approach, middle), back)


def led_in(fastest: Array, state: Moving, time: Array, angles: Array) -> tuple[Array, Array]:
    """Return time and angles with the transition from a state to their first pose before them.

    The first pose is at rest. The other arguments are those of `with_transitions`.
    """
    return in_turn(_transition(fastest, state, at_rest(angles[0])), (time, angles))


def at_rest(angles: Array) -> Moving:
    """Return the state of a limb that rests at angles (M,) [rad]."""
    return angles, np.zeros_like(angles), np.zeros_like(angles)


def in_turn(one: tuple[Array, Array], following: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return times and angles of two sequences, of which one begins where the other ends."""
    time = np.append(one[0], one[0][-1] + following[0][1:])
    return time, np.concatenate([one[1], following[1][1:]])


def smooth_step(x: ArrayLike) -> Array:
    """Return the quintic that goes from 0 to 1 with zero rate and acceleration at both ends."""
    t = np.clip(np.asarray(x, dtype=float), 0.0, 1.0)
    step: Array = t**3 * (10 + t * (6 * t - 15))
    return step


def quintic(time: Array, begin: Moving, end: Moving) -> Array:
    """Return (K, M) samples of the quintic between two states over the span of ``time`` (K,)."""
    return np.asarray(BPoly.from_derivatives([0.0, time[-1]], np.array([begin, end]))(time))


def on_grid(span: float) -> float:
    """Return a span rounded up to whole control periods."""
    return math.ceil(span / CONTROL_PERIOD - 1e-9) * CONTROL_PERIOD


def fine_grid(span: float) -> Array:
    """Return evenly spaced instants from 0 to span, about 10 ms apart."""
    return np.linspace(0.0, span, max(2, round(span / FINE_PERIOD) + 1))


def _transition(fastest: Array, begin: Moving, end: Moving) -> tuple[Array, Array]:
    """Return times and angles of the quintic between two states, at half of the slew limit."""
    half = 0.5 * fastest
    rate, acceleration = (np.maximum(*np.abs([begin[n], end[n]])) for n in (1, 2))
    by_angle = np.max(1.875 * np.abs(end[0] - begin[0]) / half)
    by_acceleration = np.max(np.sqrt(acceleration / half))
    time = fine_grid(on_grid(max(1.0, by_angle, np.max(2 * rate / half), by_acceleration)))
    return time, quintic(time, begin, end)


# How fast a course is gone through --------------------------------------------------------------


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
    rate, greatest = _slew_rates(workspace.fastest, course, place)
    if limits is not None:
        by_tip = tip_rates(workspace.arcs.tip(course(place)), place, limits)
        rate, greatest = np.minimum(rate, by_tip[0]), np.minimum(greatest, by_tip[1])
    elif np.all(rate >= 1.0) and not rest:
        samples = max(20, round(span / _GRID) + 1)
        return np.linspace(0.0, span, samples), np.linspace(0.0, span, samples)
    else:
        rate = np.minimum(rate, 1.0)
    time, along = paced(place, rate, greatest, limits is not None or rest)
    return time, np.clip(along, 0.0, span)


def _slew_rates(fastest: Array, course: PchipInterpolator, place: Array) -> tuple[Array, Array]:
    """Return what the slew limit allows at places (K,), see `paced`."""
    most = SLEW_SHARE * fastest
    bend, turn = (np.maximum(np.abs(course(place, n)), _TINY) for n in (1, 2))
    rate = np.minimum((most / bend).min(axis=1), np.sqrt(most / RISE / turn).min(axis=1))
    return rate, (most / RISE / bend).min(axis=1)


def tip_rates(tip: Array, place: Array, limits: PathLimits) -> tuple[Array, Array]:
    """Return what limits of the tip (K, 2) [m] allow at places (K,), see `paced`."""
    first = np.gradient(tip, place, axis=0)
    second = np.linalg.norm(np.gradient(first, place, axis=0), axis=1)
    speed = np.maximum(np.linalg.norm(first, axis=1), _TINY)
    across = np.sqrt(limits.acceleration / np.maximum(second, _TINY))
    return np.minimum(limits.speed / speed, across), limits.acceleration / speed


def paced(place: Array, rate: Array, greatest: Array, rest: bool) -> tuple[Array, Array]:
    """Return evenly spaced instants from 0 on [s], and the places then, with rounded corners.

    The rates are those of the fastest course that keeps its limits, found by a pass forward and one
    backward.

    Args:
        place: (K,) evenly spaced, along a course.
        rate: (K,) largest change of the place [1/s].
        greatest: (K,) largest change of that rate [1/s²].
        rest: begin and end at rest.

    Raises:
        PlanningError: it would last too long.
    """
    step = float(place[1] - place[0])
    if rest:
        rate[0] = rate[-1] = 0.0
    gain = 2 * np.minimum(greatest[1:], greatest[:-1]) * step
    for k in range(len(gain)):
        rate[k + 1] = min(rate[k + 1], math.sqrt(rate[k] ** 2 + gain[k]))
    for k in range(len(gain) - 1, -1, -1):
        rate[k] = min(rate[k], math.sqrt(rate[k + 1] ** 2 + gain[k]))
    durations = 2 * step / np.maximum(rate[1:] + rate[:-1], 1e-6)
    time = np.concatenate([[0.0], np.cumsum(durations)])
    if time[-1] > LONGEST:
        raise PlanningError(
            f"the path would last {time[-1]:.0f} s, the longest is {LONGEST:.0f} s: draw less, "
            "allow a higher speed, or give points in metres if they are not"
        )
    grid = np.linspace(0.0, time[-1], max(20, round(time[-1] / _GRID) + 1))
    step = float(grid[1])
    # A running mean that begins and ends at rest is longer by as much.
    around = max(1, round(_SOFTNESS / step))
    padded = np.pad(PchipInterpolator(time, place)(grid), around, mode="edge")
    along = uniform_filter1d(padded, 2 * around + 1, mode="nearest")
    return np.arange(len(along), dtype=np.float64) * step, along
