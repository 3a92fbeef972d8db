"""The air's law, commands to chamber pressures: dead time, lag, and outlets that are slow.

Of a pair of chambers one is to hold |command|, the other none. After a dead time each follows with
a first-order lag, one time constant while it fills and another while it is vented, but it never
falls faster than its outlet lets it:

    dp/dt ≥ −R (p / p_ref)ⁿ        R `vent_rate`, n `vent_exponent`, p_ref `VENT_REFERENCE`

An orifice would have n = 1/2, a tube n = 1 (an exponential). Logs of a real limb fit n = 0.65 with
a tenth of the error that an exponential leaves.

A valve that opens in proportion to the error p − p_goal passes (p / p_ref)ⁿ of it, so that its lag
grows as the pressure falls, and is wide open only where nothing is to be left:

    dp/dt = −(p / p_ref)ᵐ (p − p_goal) / τ       τ `vent_time_constant`, m `vent_lag_exponent`
    dp/dt = −R (p / p_ref)ⁿ                      where p_goal = 0 and m > 0

The differential pressure of a pair is the first chamber's pressure less the second's, so that a
chamber that falls too slowly can be balanced by filling its neighbour.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array, interpolate
from der_planner.limb import VENT_REFERENCE, Pneumatics

_TUBE = 1e-3
"""Exponents closer to 1 than this fall exponentially."""
_EMPTY = 0.1
"""A chamber with less pressure than this counts as empty [Pa]."""
_REMEMBERED = 100.0
"""Pressure [Pa] at whose lag a chamber is remembered."""


class AirLaw(NamedTuple):
    """The law's numbers, as the compiled functions below take them."""

    fill_lag: float  # [s]
    vent_lag: float  # [s]
    vent_speed: float  # R / p_ref [1/s]; 0 = outlets never hold a chamber up
    vent_exponent: float  # n
    lag_exponent: float  # m; 0 = the lag is the same at all pressures


class Air:
    """The air of one limb.

    Args:
        pneumatics: lag, dead time, venting and limits.

    Attributes:
        pneumatics: as given.
        law: its numbers for compiled functions.
        vents_slowly: whether outlets hold chambers up.
    """

    def __init__(self, pneumatics: Pneumatics) -> None:
        self.pneumatics = pneumatics
        self.vents_slowly = pneumatics.vent_rate > 0
        self.law = AirLaw(
            pneumatics.time_constant,
            pneumatics.vent_lag,
            pneumatics.vent_rate / VENT_REFERENCE,
            pneumatics.vent_exponent,
            pneumatics.vent_lag_exponent if self.vents_slowly else 0.0,
        )

    def follow(
        self, command: ArrayLike, period: float, steps: int, before: ArrayLike | None = None
    ) -> Chambers:
        """Return what both chambers of each pair do under commands.

        Args:
            command: (K, M) [Pa], each held for ``period`` [s].
            period: [s].
            steps: S, in which the result is sampled; the law is solved exactly in each.
            before: (M,) command in force before the first one, which the chambers had reached; none
                (vented) if None.
        """
        given = np.ascontiguousarray(command, dtype=float)
        start = np.zeros(given.shape[1]) if before is None else np.array(before, dtype=float)
        target = pair_of(_delayed(given, start, self.pneumatics.delay / period * steps, steps))
        middle, pair = _chamber_pressures(target, pair_of(start), period / steps, self.law)
        differential = middle.reshape(-1, steps, middle.shape[1])
        return Chambers(self, period, steps, start, differential, pair, target)

    def pressures_at_commands(self, command: Array, period: float) -> Array:
        """Return the differential pressures (K, M) [Pa] at the instants of commands (K, M) [Pa].

        They are read off straight lines between instants a quarter of a period after each.
        """
        middle = self.follow(command, period, 2).differential[:, 0]
        instants = np.arange(len(command)) * period
        return interpolate(instants, instants + 0.25 * period, middle)

    def even_pulse(self, period: float, steps: int) -> Array:
        """Return the change (R,) of the pressure in the steps after one command rises by one [-].

        For a limb whose outlets never hold a chamber up; with the mean lag of filling and venting,
        so that it is exact where the two are alike.
        """
        of = self.pneumatics
        mean = 0.5 * (of.time_constant + of.vent_lag)
        reach = int(np.ceil((of.delay + 12 * mean) / period)) + 1
        command = np.zeros((reach, 1))
        command[0] = 1.0
        even = Air(replace(of, time_constant=mean, vent_time_constant=0.0, vent_rate=0.0))
        return even.follow(command, period, steps).differential.ravel()

    @property
    def memory(self) -> float:
        """For how long after a command its chambers can still tell of it [s]."""
        of = self.pneumatics
        little_left = 1.0 / float(lag_rate(_REMEMBERED, self.law))
        lag = max(of.time_constant, of.vent_lag, 0.1 * little_left)
        return of.delay + 25 * lag + self.vent_memory

    @property
    def vent_memory(self) -> float:
        """How long the fullest chamber takes until hardly anything is left in it [s]."""
        if not self.vents_slowly:
            return 0.0
        of, speed = self.pneumatics, self.law.vent_speed
        power = 1.0 - of.vent_exponent
        full, empty = of.pressure_limit / VENT_REFERENCE, _EMPTY / VENT_REFERENCE
        if power < _TUBE:
            return float(np.log(full / empty)) / speed
        return float(full**power - empty**power) / power / speed


@dataclass(frozen=True)
class Chambers:
    """What the chambers do under K commands, each held for S steps.

    Attributes:
        air: that fills and vents them.
        period: of a command [s].
        steps: S.
        before: (M,) command and differential pressure before the first command [Pa].
        differential: (K, S, M) differential pressure in the middle of each step [Pa].
        pair: (K·S, M, 2) gauge pressure of both chambers at the end of each step [Pa].
        target: (K·S, M, 2) what both chambers are commanded to hold, after the dead time [Pa].
    """

    air: Air
    period: float
    steps: int
    before: Array
    differential: Array
    pair: Array
    target: Array

    def derivative(self, first: int = 0) -> Array:
        """Return ∂(differential pressure in the middle of a step)/∂command (W, S, W, M) [-].

        Row (w, s) is step s of command ``first + w``, the third index the command that is changed;
        only the W commands from ``first`` on count. Exact but where a command is zero: there it
        counts as positive.
        """
        negative = self.target[..., 1] > 0
        delay = self.air.pneumatics.delay / self.period * self.steps
        before = np.concatenate([pair_of(self.before)[None], self.pair[:-1]])
        slopes = _slopes(before, self.target, self.period / self.steps, self.air.law)
        last = len(self.target) // self.steps
        spread: Array = _spread(slopes, negative, delay, self.steps, first, last)
        return spread


def pair_of(differential: Array) -> Array:
    """Return (…, 2) what the chambers of a pair hold for a differential pressure (…) [Pa]."""
    pair: Array = np.stack([np.maximum(differential, 0.0), np.maximum(-differential, 0.0)], axis=-1)
    return pair


def _delayed(command: Array, start: Array, delay: float, steps: int) -> Array:
    """Return the commands (K·S, M) in force in each step, ``delay`` steps late."""
    in_force = np.repeat(command, steps, axis=0)
    if delay > 0:
        whole, part = int(delay), delay - int(delay)
        padded = np.concatenate([np.tile(start, (whole + 1, 1)), in_force])
        in_force = (1 - part) * padded[1 : len(in_force) + 1] + part * padded[: len(in_force)]
    return in_force


@njit(cache=True, nogil=True)
def vented(pressure: float, fall: float, exponent: float) -> float:
    """Return the pressure [Pa] after dp/dt = −R (p / p_ref)ⁿ; ``fall`` is R/p_ref × time."""
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
def lag_rate(pressure: float, law: AirLaw) -> float:
    """Return 1 / lag [1/s] of a chamber that is vented, at its pressure [Pa]."""
    if law.lag_exponent == 0.0:
        return float(1.0 / law.vent_lag)
    return float((max(pressure, _EMPTY) / VENT_REFERENCE) ** law.lag_exponent / law.vent_lag)


@njit(cache=True, nogil=True)
def fallen(pressure: float, goal: float, span: float, law: AirLaw) -> tuple[float, bool]:
    """Return the pressure [Pa] of a vented chamber after a time [s], and if its outlet held it."""
    choked = vented(pressure, law.vent_speed * span, law.vent_exponent)
    if law.lag_exponent > 0.0 and goal == 0.0:
        return choked, True
    led = goal + (pressure - goal) * np.exp(-span * lag_rate(pressure, law))
    return max(choked, led), choked > led


@njit(cache=True, nogil=True)
def _chamber_pressures(target: Array, start: Array, h: float, law: AirLaw) -> tuple[Array, Array]:
    """Return differential pressures (N, M) amid the steps and both chambers' (N, M, 2) after."""
    count, inputs, _ = target.shape
    middle = np.empty((count, inputs))
    pair = np.empty((count, inputs, 2))
    filling, half_filling = np.exp(-h / law.fill_lag), np.exp(-0.5 * h / law.fill_lag)
    for m in range(inputs):
        for side in range(2):
            state = start[m, side]
            for k in range(count):
                goal = target[k, m, side]
                gap = state - goal
                if gap <= 0.0:
                    between, state = goal + gap * half_filling, goal + gap * filling
                else:
                    between = fallen(state, goal, 0.5 * h, law)[0]
                    state = fallen(state, goal, h, law)[0]
                pair[k, m, side] = state
                middle[k, m] = between if side == 0 else middle[k, m] - between
    return middle, pair


@njit(cache=True, nogil=True)
def _slopes(before: Array, target: Array, h: float, law: AirLaw) -> Array:
    """Return the derivatives (4, N, M, 2) of each step by the state before it and by its target.

    In this order: ∂middle/∂state, ∂middle/∂target, ∂end/∂state, ∂end/∂target.
    """
    count, inputs, sides = target.shape
    result = np.empty((4, count, inputs, sides))
    for k in range(count):
        for m in range(inputs):
            for side in range(sides):
                state, goal = before[k, m, side], target[k, m, side]
                for half in range(2):
                    span = 0.5 * h if half == 0 else h
                    share, choked = np.exp(-span / law.fill_lag), False
                    by_state = share
                    if state > goal:
                        left, choked = fallen(state, goal, span, law)
                        rate = lag_rate(state, law)
                        share = np.exp(-span * rate)
                        # The lag itself changes with the pressure.
                        grows = (state - goal) * span * rate * law.lag_exponent / state
                        by_state = share * (1.0 - grows)
                        if choked:
                            by_state = (left / state) ** law.vent_exponent
                    result[2 * half, k, m, side] = by_state
                    result[2 * half + 1, k, m, side] = 0.0 if choked else 1.0 - share
    return result


@njit(cache=True, nogil=True)
def _spread(
    slopes: Array,
    negative: NDArray[np.bool_],
    delay: float,
    steps: int,
    first: int,
    last: int,
) -> Array:
    """Return the change (W, S, W, M) of the differential pressure in each step by each command."""
    inputs = slopes.shape[2]
    result = np.zeros((last - first, steps, last - first, inputs))
    whole, part = int(delay), delay - int(delay)
    for m in range(inputs):
        for k in range(first, last):
            begin = k * steps + whole
            change = np.zeros(2)
            for n in range(begin, last * steps):
                share = 0.0
                if n == begin:
                    share = 1.0 - part
                elif n < begin + steps:
                    share = 1.0
                elif n == begin + steps:
                    share = part
                for side in range(2):
                    # A positive command fills the first chamber, a negative one the second.
                    goal = share if negative[n, m] == (side == 1) else 0.0
                    by = slopes[:, n, m, side]
                    middle = by[0] * change[side] + by[1] * goal
                    change[side] = by[2] * change[side] + by[3] * goal
                    result[n // steps - first, n % steps, k - first, m] += middle
    return result
