"""Commands within their limits for wanted pressures in the chambers: the inverse of the air."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from der_planner.arrays import Array, interpolate
from der_planner.limb import VENT_REFERENCE
from der_planner.model.air import Air, AirLaw, fallen

_SHARES_BEFORE = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Shares of a ramp that may come before the jump that it replaces."""


def commands(air: Air, time: Array, pressure: Array, period: float) -> Array:
    """Return the commands (K, M) [Pa] under which the chambers hold wanted pressures.

    The pressure that is wanted in the middle of a command's period, a dead time later, is led by
    the lag. Where a wanted pressure changes its sign, one chamber is nearly empty and the other not
    yet filled, and the exact inverse of slow venting jumps there: the jump becomes a ramp at the
    slew limit, part of it ahead of the jump.

    Args:
        air: of the limb.
        time: (F,) fine grid [s] from 0 that reaches past the last command by period and dead time.
        pressure: (F, M) wanted differential pressures [Pa].
        period: of the commands [s].
    """
    delay = air.pneumatics.delay
    led = leading_commands(air, time, pressure)
    last = time[-1] - period - delay
    instants = np.arange(round(last / period) + 1) * period + period / 2 + delay
    wanted = interpolate(instants, time, led)
    return _drawn_out(air, wanted, period, time, pressure) if air.vents_slowly else wanted


def _drawn_out(air: Air, command: Array, period: float, time: Array, pressure: Array) -> Array:
    """Return commands (K, M) [Pa] within the slew limit that bring the wanted pressures about best.

    How much of each ramp comes before its jump is chosen, segment by segment, by simulating the
    chambers under every share in `_SHARES_BEFORE`.
    """
    wanted = interpolate((np.arange(len(command)) + 0.5) * period, time, pressure)
    step = air.pneumatics.slew_limit * period
    best, least = command, np.full(command.shape[1], np.inf)
    for share in _SHARES_BEFORE:
        ramps = limit_slew(_advanced(command, step, share), command[0], step)
        reached = air.follow(ramps, period, 2, pressure[0]).differential.mean(axis=1)
        missed = ((reached - wanted) ** 2).sum(axis=0)
        best, least = np.where(missed < least, ramps, best), np.minimum(missed, least)
    return best


@njit(cache=True, nogil=True)
def _advanced(command: Array, step: float, share: float) -> Array:
    """Return commands whose jumps come earlier by a share of the ramp that they will become."""
    result = command.copy()
    for m in range(command.shape[1]):
        for k in range(1, command.shape[0]):
            jump = command[k, m] - command[k - 1, m]
            if abs(jump) > 2.0 * step:
                begin = max(0, k - int(share * abs(jump) / step))
                result[begin:k, m] = command[k, m]
    return result


def within_limits(
    pressures: ArrayLike, air: Air, period: float, initial: ArrayLike | None = None
) -> tuple[Array, float]:
    """Return commands (K, M) [Pa] that keep the limits, and the largest change made to them [Pa].

    Args:
        pressures: (K, M) wanted [Pa].
        air: pressure and slew limit.
        period: between two commands [s].
        initial: (M,) command before the first one [Pa]; vented if None.
    """
    wanted = np.asarray(pressures, dtype=float)
    start = np.zeros(wanted.shape[1]) if initial is None else np.array(initial, dtype=float)
    limit, step = air.pneumatics.pressure_limit, air.pneumatics.slew_limit * period
    kept = limit_slew(np.clip(wanted, -limit, limit), start, step)
    return kept, float(np.abs(kept - wanted).max(initial=0.0))


@njit(cache=True, nogil=True)
def limit_slew(wanted: Array, start: Array, step: float) -> Array:
    """Return commands (K, M) [Pa] that follow the wanted ones by at most a step [Pa] each.

    Args:
        wanted: (K, M) [Pa].
        start: (M,) command before the first one [Pa].
        step: largest change from one to the next [Pa].
    """
    result = np.empty_like(wanted)
    for m in range(wanted.shape[1]):
        last = start[m]
        for k in range(wanted.shape[0]):
            last = min(max(wanted[k, m], last - step), last + step)
            result[k, m] = last
    return result


# The inverse of lag and venting ----------------------------------------------------------------


def leading_commands(air: Air, time: Array, pressure: Array) -> Array:
    """Return what the chambers have to be commanded (F, M) [Pa] to hold wanted pressures in time.

    The inverse of lag and venting; the dead time is the caller's, who asks for later pressures.
    Where a chamber cannot fall as fast as is wanted, its neighbour is filled by the difference.

    Args:
        air: lag and venting.
        time: (F,) rising instants [s].
        pressure: (F, M) wanted differential pressures [Pa].
    """
    fill, vent = air.law.fill_lag, air.law.vent_lag
    if not air.vents_slowly:
        slope = np.gradient(pressure, time, axis=0)
        led: Array = pressure + np.where(pressure * slope >= 0, fill, vent) * slope
        return led
    chambers, second = least_pairs(time, pressure, air.law)
    slope = np.gradient(chambers, time, axis=1)
    # Below a tenth of the reference a lag would ask for less than nothing.
    full = np.maximum(chambers / VENT_REFERENCE, 0.1)
    lag = np.where(slope >= 0, fill, vent * full**-air.law.lag_exponent)
    pair = np.maximum(chambers + lag * slope, 0.0)
    filled: Array = np.where(second, -pair[1], pair[0])
    return filled


@njit(cache=True, nogil=True)
def least_pairs(time: Array, wanted: Array, law: AirLaw) -> Any:
    """Return the least gauge pressures (2, F, M) [Pa] of chambers whose difference is wanted.

    Also which chamber the command has to fill (F, M): the second, or the first. ``time`` (F,) and
    ``wanted`` (F, M) are as of `leading_commands`.
    """
    count, inputs = wanted.shape
    chambers = np.empty((2, count, inputs))
    second = np.zeros((count, inputs), dtype=np.bool_)
    for m in range(inputs):
        left, right = max(wanted[0, m], 0.0), max(-wanted[0, m], 0.0)
        for k in range(count):
            if k > 0:
                h = time[k] - time[k - 1]
                left = fallen(left, 0.0, h, law)[0]
                right = fallen(right, 0.0, h, law)[0]
            gap = wanted[k, m] + right - left
            second[k, m] = gap < 0.0
            left, right = left + max(gap, 0.0), right + max(-gap, 0.0)
            chambers[0, k, m], chambers[1, k, m] = left, right
    return chambers, second


@dataclass(frozen=True)
class SlowVenting:
    """Where a motion wants one pressure to fall faster than its chamber is vented.

    Attributes:
        index: of the pressure.
        time: when it should fall fastest in comparison with what its chamber does by itself [s].
        wanted: rate at which it should fall then [Pa/s].
        possible: rate at which the chamber falls then [Pa/s].
        opposite: the largest pressure that the opposite chamber needs to balance the slow one [Pa].
    """

    index: int
    time: float
    wanted: float
    possible: float
    opposite: float


def slow_venting(air: Air, time: Array, pressure: Array) -> SlowVenting | None:
    """Return the worst of the pressures (F, M) [Pa] that should fall too fast at times (F,) [s].

    None for a limb whose outlets never hold a chamber up.
    """
    if not air.vents_slowly:
        return None
    chambers, _ = least_pairs(time, pressure, air.law)
    both = np.minimum(chambers[0], chambers[1])
    j = int(np.argmax(both.max(axis=0)))
    fall = -np.gradient(np.abs(pressure[:, j]), time)
    fuller = np.maximum(chambers[0, :, j], chambers[1, :, j])
    of = air.pneumatics
    possible = of.vent_rate * (fuller / VENT_REFERENCE) ** of.vent_exponent
    k = int(np.argmax(fall - possible))
    return SlowVenting(
        j, float(time[k]), float(fall[k]), float(possible[k]), float(both[:, j].max())
    )
