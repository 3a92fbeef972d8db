"""Commands within their limits for wanted effective pressures: the inverse of air and material."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb, Pneumatics
from der_planner.model import air as law
from der_planner.model import material
from der_planner.model.series import interpolate

Array = NDArray[np.float64]

_SHARES_BEFORE = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Shares of a ramp that may come before the jump that it replaces."""


def commands(limb: Limb, time: Array, effective: Array, bend: Array, period: float) -> Array:
    """Return the commands (K, M) [Pa] under which the limb feels effective pressures.

    The pressure that is wanted in the middle of a command's period, a dead time later, is led by
    the lag. Where a wanted pressure changes its sign, one chamber is nearly empty and the other not
    yet filled, and the exact inverse of slow venting jumps there: the jump becomes a ramp at the
    slew limit, part of it ahead of the jump.

    Args:
        limb: calibrated limb.
        time: (F,) fine grid [s] from 0 that reaches past the last command by period and dead time.
        effective: (F, M) [Pa].
        bend: (F, M) bend angles along the motion [rad].
        period: of the commands [s].
    """
    pressure = material.differential_pressure(limb, time, effective, bend)
    air = limb.pneumatics
    led = law.leading_commands(air, time, pressure)
    last = time[-1] - period - air.delay
    instants = np.arange(round(last / period) + 1) * period + period / 2 + air.delay
    wanted = interpolate(instants, time, led)
    return _drawn_out(air, wanted, period, time, pressure) if air.vent_rate > 0 else wanted


def _drawn_out(
    air: Pneumatics, command: Array, period: float, time: Array, pressure: Array
) -> Array:
    """Return commands (K, M) [Pa] within the slew limit that bring the wanted pressures about best.

    How much of each ramp comes before its jump is chosen, segment by segment, by simulating the
    chambers under every share in `_SHARES_BEFORE`.
    """
    instants = (np.arange(len(command)) + 0.5) * period
    wanted = interpolate(instants, time, pressure)
    step = air.slew_limit * period
    best, least = command, np.full(command.shape[1], np.inf)
    for share in _SHARES_BEFORE:
        ramps = _limit_slew(_advanced(command, step, share), command[0], step)
        held = law.chamber_pressures(air, ramps, period, 2, pressure[0]).mean(axis=1)
        missed = ((held - wanted) ** 2).sum(axis=0)
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
    pressures: ArrayLike, air: Pneumatics, period: float, initial: ArrayLike | None = None
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
    limit = air.pressure_limit
    kept = _limit_slew(np.clip(wanted, -limit, limit), start, air.slew_limit * period)
    return kept, float(np.abs(kept - wanted).max(initial=0.0))


@njit(cache=True, nogil=True)
def _limit_slew(wanted: Array, start: Array, step: float) -> Array:
    result = np.empty_like(wanted)
    for m in range(wanted.shape[1]):
        last = start[m]
        for k in range(wanted.shape[0]):
            last = min(max(wanted[k, m], last - step), last + step)
            result[k, m] = last
    return result
