"""What lies between a command and the pressure that the linear model feels, as the planners see it.

A command is held for one control period. The chambers follow it after a dead time with a
first-order lag, one time constant while |pressure| rises and another while it falls. What they
hold becomes the *effective* pressure of `der_planner.actuation`: unequal chambers, stiffening,
friction and creep along a known bend.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner import actuation
from der_planner.limb import Limb, Pneumatics

Vector = NDArray[np.float64]


def commands(limb: Limb, time: Vector, effective: Vector, bend: Vector, period: float) -> Vector:
    """Return the commands (K, M) [Pa] that make the limb feel effective pressures.

    The inverse of hold, dead time and lag: what is wanted in the middle of a held period, led by
    the lag.

    Args:
        limb: calibrated limb.
        time: (F,) fine grid [s] from 0 that reaches past the last command by period and dead time.
        effective: (F, M) [Pa].
        bend: (F, M) bend angles along the motion [rad].
        period: of the commands [s].
    """
    pressure = actuation.differential_pressure(limb, time, effective, bend)
    slope = np.gradient(pressure, time, axis=0)
    air = limb.pneumatics
    vent = air.vent_time_constant or air.time_constant
    lag = np.where(pressure * slope >= 0, air.time_constant, vent)
    led = pressure + lag * slope
    last = time[-1] - period - air.delay
    instants = np.arange(round(last / period) + 1) * period + period / 2 + air.delay
    return np.column_stack([np.interp(instants, time, column) for column in led.T])


def chamber_pressures(
    air: Pneumatics,
    command: ArrayLike,
    period: float,
    substeps: int,
    initial: ArrayLike | None = None,
) -> Vector:
    """Return the chambers' differential pressures (K, S, M) [Pa] in the middle of each substep.

    Args:
        air: lag and dead time.
        command: (K, M) [Pa], each held for ``period`` [s].
        period: [s].
        substeps: S.
        initial: (M,) pressure at the first command, and the command before it; vented if None.
    """
    commands_ = np.ascontiguousarray(command, dtype=float)
    start = np.zeros(commands_.shape[1]) if initial is None else np.array(initial, dtype=float)
    delay = air.delay / period * substeps
    held = np.repeat(commands_, substeps, axis=0)
    if delay > 0:
        whole, part = int(delay), delay - int(delay)
        padded = np.concatenate([np.tile(start, (whole + 1, 1)), held])
        held = (1 - part) * padded[1 : len(held) + 1] + part * padded[: len(held)]
    vent = air.vent_time_constant or air.time_constant
    pressure = _lag(held, start, period / substeps, air.time_constant, vent)
    shaped: Vector = pressure.reshape(len(commands_), substeps, commands_.shape[1])
    return shaped


@njit(cache=True, nogil=True)
def _lag(command: Vector, start: Vector, h: float, fill: float, vent: float) -> Vector:
    result = np.empty_like(command)
    for m in range(command.shape[1]):
        state = start[m]
        for k in range(command.shape[0]):
            goal = command[k, m]
            falling = abs(goal) < abs(state) and goal * state >= 0
            tau = vent if falling else fill
            result[k, m] = goal + (state - goal) * np.exp(-0.5 * h / tau)
            state = goal + (state - goal) * np.exp(-h / tau)
    return result


def within_limits(
    pressures: ArrayLike, air: Pneumatics, period: float, initial: ArrayLike | None = None
) -> tuple[Vector, float]:
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
def _limit_slew(wanted: Vector, start: Vector, step: float) -> Vector:
    result = np.empty_like(wanted)
    for m in range(wanted.shape[1]):
        last = start[m]
        for k in range(wanted.shape[0]):
            last = min(max(wanted[k, m], last - step), last + step)
            result[k, m] = last
    return result
