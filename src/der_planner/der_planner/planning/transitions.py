"""Transitions between poses: quintics from rest to a motion, from one to another, back to rest.

All are sequences of bend angles (K, M) [rad] on a fine grid of instants; `resting_spline` turns
the whole of them into a function that can be differentiated twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from der_planner.arrays import Array
from der_planner.model.series import CONTROL_PERIOD

FINE_PERIOD = 0.01
"""Time between two samples of a transition, about [s]."""


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
    ends = [(inner(t), inner(t, 1), inner(t, 2)) for t in (time[0], time[-1])]
    zero = np.zeros_like(home)
    lead = _travel_time(fastest, ends[0], home)
    tail = _travel_time(fastest, ends[1], home)
    approach = quintic(fine_grid(lead), home, zero, zero, *ends[0])
    back = quintic(fine_grid(tail), *ends[1], home, zero, zero)
    between = fine_grid(on_grid(time[-1] - time[0]))
    middle = inner(np.minimum(time[0] + between, time[-1]))
    instants = [
        fine_grid(lead),
        lead + between[1:],
        lead + between[-1] + fine_grid(tail)[1:],
    ]
    return np.concatenate(instants), np.concatenate([approach, middle[1:], back[1:]])


def smooth_step(x: ArrayLike) -> Array:
    """Return the quintic that goes from 0 to 1 with zero rate and acceleration at both ends."""
    t = np.clip(np.asarray(x, dtype=float), 0.0, 1.0)
    step: Array = t**3 * (10 + t * (6 * t - 15))
    return step


def quintic(time: Array, x0: Array, v0: Array, a0: Array, x1: Array, v1: Array, a1: Array) -> Array:
    """Return (K, M) samples of the quintic between two states over the span of ``time`` (K,)."""
    span = float(time[-1])
    t = (time / span)[:, None]
    start = (x0, span * v0, span**2 * a0)
    end = (x1, span * v1, span**2 * a1)
    difference = end[0] - start[0] - start[1] - 0.5 * start[2]
    slope = end[1] - start[1] - start[2]
    bow = end[2] - start[2]
    c3 = 10 * difference - 4 * slope + 0.5 * bow
    c4 = -15 * difference + 7 * slope - bow
    c5 = 6 * difference - 3 * slope + 0.5 * bow
    result: Array = start[0] + t * (start[1] + t * (0.5 * start[2] + t * (c3 + t * (c4 + t * c5))))
    return result


def led_in(
    fastest: Array, state: tuple[Array, Array, Array], time: Array, angles: Array
) -> tuple[Array, Array]:
    """Return time and angles with the transition from a state to their first pose before them.

    The state is angle [rad], rate [rad/s] and acceleration [rad/s²], each (M,); the first pose is
    at rest. The other arguments are those of `with_transitions`.
    """
    zero = np.zeros_like(fastest)
    lead = fine_grid(_travel_time(fastest, state, angles[0]))
    approach = quintic(lead, *state, angles[0], zero, zero)
    return np.append(lead, lead[-1] + time[1:]), np.concatenate([approach, angles[1:]])


def on_grid(span: float) -> float:
    """Return a span rounded up to whole control periods."""
    return math.ceil(span / CONTROL_PERIOD - 1e-9) * CONTROL_PERIOD


def fine_grid(span: float) -> Array:
    """Return evenly spaced instants from 0 to span, about 10 ms apart."""
    return np.linspace(0.0, span, max(2, round(span / FINE_PERIOD) + 1))


def _travel_time(fastest: Array, state: tuple[Array, Array, Array], home: Array) -> float:
    """Return how long the limb takes between rest at home and a state, at half of its slew limit.

    Angles (M,) in rad, the result in s.
    """
    half = 0.5 * fastest
    angle, rate, acceleration = (np.abs(p) for p in (state[0] - home, state[1], state[2]))
    by_angle = np.max(1.875 * angle / half)
    by_rate = np.max(2 * rate / half)
    by_acceleration = np.max(np.sqrt(acceleration / half))
    return on_grid(max(1.0, by_angle, by_rate, by_acceleration))
