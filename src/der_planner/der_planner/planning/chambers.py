"""The law of a pair of chambers behind its valves: dead time, lag, and outlets that are slow.

Of a pair one chamber is to hold |command|, the other none. After a dead time each follows with a
first-order lag, one time constant while it fills and another while it is vented, but it never falls
faster than its outlet lets it:

    dp/dt ≥ −R (p / p_ref)ⁿ        R `vent_rate`, n `vent_exponent`, p_ref `VENT_REFERENCE`

Between an orifice (n = 1/2) and a tube (n = 1, one exponential) lie the logs of a real limb: 0.65,
with a tenth of the error that an exponential leaves.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import VENT_REFERENCE, Pneumatics

Vector = NDArray[np.float64]

_TUBE = 1e-3
"""Exponents closer to 1 than this fall exponentially."""
_EMPTY = 0.1
"""What is left of a chamber's pressure when it is forgotten [Pa]."""


@dataclass(frozen=True)
class Response:
    """What chambers do under commands, in the K·S substeps.

    Attributes:
        pressure: (K·S, M) differential pressures in the middle of each [Pa].
        pair: (K·S, M, 2) both chambers' gauge pressures at its end [Pa].
        held: (K·S, M, 2) commands to both chambers, after the dead time [Pa].
    """

    pressure: Vector
    pair: Vector
    held: Vector


def respond(
    air: Pneumatics,
    command: ArrayLike,
    period: float,
    substeps: int,
    initial: ArrayLike | None = None,
) -> Response:
    """Return what both chambers of each pair do.

    Args:
        air: lag, dead time and venting.
        command: (K, M) [Pa], each held for ``period`` [s].
        period: [s].
        substeps: S.
        initial: (M,) pressure at the first command, and the command before it; vented if None.
    """
    commands_ = np.ascontiguousarray(command, dtype=float)
    start = np.zeros(commands_.shape[1]) if initial is None else np.array(initial, dtype=float)
    held = _pair(_delayed(commands_, start, air.delay / period * substeps, substeps))
    middle, pair = _follow(
        held,
        _pair(start),
        period / substeps,
        air.time_constant,
        air.vent_lag,
        vent_speed(air),
        air.vent_exponent,
    )
    return Response(middle, pair, held)


def _pair(differential: Vector) -> Vector:
    """Return (..., 2) what the chambers of a pair hold for a differential pressure [Pa]."""
    return np.stack([np.maximum(differential, 0.0), np.maximum(-differential, 0.0)], axis=-1)


def _delayed(command: Vector, start: Vector, delay: float, substeps: int) -> Vector:
    """Return the commands (K·S, M) in force in each substep, ``delay`` substeps late."""
    held = np.repeat(command, substeps, axis=0)
    if delay > 0:
        whole, part = int(delay), delay - int(delay)
        padded = np.concatenate([np.tile(start, (whole + 1, 1)), held])
        held = (1 - part) * padded[1 : len(held) + 1] + part * padded[: len(held)]
    return held


def vent_speed(air: Pneumatics) -> float:
    """Return the vent rate over the reference pressure [1/s], as `vented` takes it."""
    return air.vent_rate / VENT_REFERENCE


def vent_memory(air: Pneumatics) -> float:
    """Return how long the fullest chamber takes until hardly anything is left in it [s]."""
    if air.vent_rate == 0:
        return 0.0
    power = 1.0 - air.vent_exponent
    full, empty = air.pressure_limit / VENT_REFERENCE, _EMPTY / VENT_REFERENCE
    if power < _TUBE:
        return float(np.log(full / empty)) / vent_speed(air)
    return float(full**power - empty**power) / power / vent_speed(air)


@njit(cache=True, nogil=True)
def vented(pressure: float, fall: float, exponent: float) -> float:
    """Return what is left of a pressure [Pa] after venting; ``fall`` is the rate times the time."""
    if fall <= 0.0 or pressure <= 0.0:
        return 0.0
    power = 1.0 - exponent
    if power < _TUBE:
        return float(pressure * np.exp(-fall))
    left = (pressure / VENT_REFERENCE) ** power - power * fall
    if left <= 0.0:
        return 0.0
    return float(VENT_REFERENCE * left ** (1.0 / power))


@njit(cache=True, nogil=True)
def _follow(
    held: Vector,
    start: Vector,
    h: float,
    fill: float,
    vent: float,
    rate: float,
    exponent: float,
) -> tuple[Vector, Vector]:
    """Return differential pressures (N, M) amid the steps and both chambers' (N, M, 2) after."""
    count, inputs, _ = held.shape
    middle = np.empty((count, inputs))
    pair = np.empty((count, inputs, 2))
    filling, half_filling = np.exp(-h / fill), np.exp(-0.5 * h / fill)
    venting, half_venting = np.exp(-h / vent), np.exp(-0.5 * h / vent)
    for m in range(inputs):
        for side in range(2):
            sign = 1.0 - 2.0 * side
            state = start[m, side]
            for k in range(count):
                goal = held[k, m, side]
                gap = state - goal
                if gap <= 0.0:
                    between, state = goal + gap * half_filling, goal + gap * filling
                else:
                    between = max(
                        goal + gap * half_venting, vented(state, 0.5 * rate * h, exponent)
                    )
                    state = max(goal + gap * venting, vented(state, rate * h, exponent))
                pair[k, m, side] = state
                middle[k, m] = between if side == 0 else middle[k, m] + sign * between
    return middle, pair


def sensitivity(
    air: Pneumatics, response: Response, initial: Vector, period: float, substeps: int, first: int
) -> Vector:
    """Return ∂(mean pressure of a period)/∂command (W, W, M) from command ``first`` on.

    Exact but where a command is zero: there it counts as positive.

    Args:
        air: lag, dead time and venting.
        response: of the commands from the beginning.
        initial: as of the response.
        period: of the commands [s].
        substeps: S.
        first: of the W commands.
    """
    count = len(response.held) // substeps
    before = np.concatenate([_pair(initial)[None], response.pair[:-1]])
    keep = _kept(
        before,
        response.held,
        period / substeps,
        air.time_constant,
        air.vent_lag,
        vent_speed(air),
        air.vent_exponent,
    )
    negative = response.held[..., 1] > 0
    spread: Vector = _spread(keep, negative, air.delay / period * substeps, substeps, first, count)
    return spread


@njit(cache=True, nogil=True)
def _kept(
    before: Vector,
    held: Vector,
    h: float,
    fill: float,
    vent: float,
    rate: float,
    exponent: float,
) -> Vector:
    """Return the derivatives (4, N, M, 2) of each step: by the state and by the command.

    In this order: ∂middle/∂state, ∂middle/∂command, ∂end/∂state, ∂end/∂command.
    """
    count, inputs, sides = held.shape
    result = np.empty((4, count, inputs, sides))
    for k in range(count):
        for m in range(inputs):
            for side in range(sides):
                state, goal = before[k, m, side], held[k, m, side]
                for half in range(2):
                    span = 0.5 * h if half == 0 else h
                    share = np.exp(-span / (fill if state <= goal else vent))
                    left = vented(state, rate * span, exponent) if state > goal else 0.0
                    choked = left > goal + (state - goal) * share
                    by_state = (left / state) ** exponent if choked else share
                    result[2 * half, k, m, side] = by_state
                    result[2 * half + 1, k, m, side] = 0.0 if choked else 1.0 - share
    return result


@njit(cache=True, nogil=True)
def _spread(
    slopes: Vector,
    negative: NDArray[np.bool_],
    delay: float,
    substeps: int,
    first: int,
    last: int,
) -> Vector:
    """Return the mean change (W, W, M) of the pressure in each period by each command."""
    inputs = slopes.shape[2]
    result = np.zeros((last - first, last - first, inputs))
    whole, part = int(delay), delay - int(delay)
    for m in range(inputs):
        for k in range(first, last):
            begin = k * substeps + whole
            change = np.zeros(2)
            for n in range(begin, last * substeps):
                share = 0.0
                if n == begin:
                    share = 1.0 - part
                elif n < begin + substeps:
                    share = 1.0
                elif n == begin + substeps:
                    share = part
                for side in range(2):
                    # A positive command fills the first chamber, a negative one the second.
                    goal = share if negative[n, m] == (side == 1) else 0.0
                    by = slopes[:, n, m, side]
                    middle = by[0] * change[side] + by[1] * goal
                    change[side] = by[2] * change[side] + by[3] * goal
                    result[n // substeps - first, k - first, m] += middle / substeps
    return result
