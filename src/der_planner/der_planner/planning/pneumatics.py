"""What lies between a command and the pressure that the linear model feels, as the planners see it.

A command is held for one control period; the chambers follow it as `der_planner.planning.chambers`
says. The differential pressure is one chamber's less the other's, so that a chamber that its outlet
leaves behind can be made up for: a command of the other sign fills its neighbour. What the chambers
hold becomes the *effective* pressure of `der_planner.actuation`: unequal chambers, stiffening,
friction and creep along a known bend.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner import actuation
from der_planner.limb import VENT_REFERENCE, Limb, Pneumatics
from der_planner.planning.chambers import respond, vent_speed, vented

Vector = NDArray[np.float64]

_SHARES_BEFORE = (0.0, 0.2, 0.4, 0.6, 0.8)
"""Shares of a ramp that may come before the jump that it replaces."""


def commands(limb: Limb, time: Vector, effective: Vector, bend: Vector, period: float) -> Vector:
    """Return the commands (K, M) [Pa] that make the limb feel effective pressures.

    The inverse of hold, dead time, lag and venting: what is wanted in the middle of a held period,
    led by the lag. Where a chamber cannot fall as fast, its neighbour is filled by the difference;
    on the way from one chamber to the other the command may do as it likes, since neither listens:
    a jump becomes a ramp at the slew limit that begins ahead of it.

    Args:
        limb: calibrated limb.
        time: (F,) fine grid [s] from 0 that reaches past the last command by period and dead time.
        effective: (F, M) [Pa].
        bend: (F, M) bend angles along the motion [rad].
        period: of the commands [s].
    """
    pressure = actuation.differential_pressure(limb, time, effective, bend)
    air = limb.pneumatics
    fill, vent = air.time_constant, air.vent_lag
    if air.vent_rate > 0:
        chambers, second = _hold_pairs(
            np.ascontiguousarray(pressure), np.diff(time), vent, vent_speed(air), air.vent_exponent
        )
        slope = np.gradient(chambers, time, axis=1)
        pair = np.maximum(chambers + np.where(slope >= 0, fill, vent) * slope, 0.0)
        led = np.where(second, -pair[1], pair[0])
    else:
        slope = np.gradient(pressure, time, axis=0)
        led = pressure + np.where(pressure * slope >= 0, fill, vent) * slope
    last = time[-1] - period - air.delay
    instants = np.arange(round(last / period) + 1) * period + period / 2 + air.delay
    wanted = np.column_stack([np.interp(instants, time, column) for column in led.T])
    return _drawn_out(air, wanted, period, time, pressure) if air.vent_rate > 0 else wanted


def _drawn_out(
    air: Pneumatics, command: Vector, period: float, time: Vector, pressure: Vector
) -> Vector:
    """Return commands (K, M) [Pa] within the slew limit that bring the wanted pressures about best.

    A jump becomes a ramp, and how much of the ramp comes before the jump is tried out on the air.
    """
    instants = (np.arange(len(command)) + 0.5) * period
    wanted = np.column_stack([np.interp(instants, time, column) for column in pressure.T])
    step = air.slew_limit * period
    best, least = command, np.full(command.shape[1], np.inf)
    for share in _SHARES_BEFORE:
        ramps = _limit_slew(_advanced(command, step, share), command[0], step)
        held = chamber_pressures(air, ramps, period, 2, pressure[0]).mean(axis=1)
        missed = ((held - wanted) ** 2).sum(axis=0)
        best, least = np.where(missed < least, ramps, best), np.minimum(missed, least)
    return best


@njit(cache=True, nogil=True)
def _advanced(command: Vector, step: float, share: float) -> Vector:
    """Return commands whose jumps come earlier by a share of the ramp that they will become."""
    result = command.copy()
    for m in range(command.shape[1]):
        for k in range(1, command.shape[0]):
            jump = command[k, m] - command[k - 1, m]
            if abs(jump) > 2.0 * step:
                begin = max(0, k - int(share * abs(jump) / step))
                result[begin:k, m] = command[k, m]
    return result


@dataclass(frozen=True)
class SlowVenting:
    """Where a motion wants one pressure to fall faster than its chamber is vented.

    Attributes:
        index: of the pressure.
        time: when it falls fastest beyond the chamber's own fall [s].
        wanted: rate at which it should fall then [Pa/s].
        possible: rate at which the chamber falls then [Pa/s].
        opposite: the most that the opposite chamber has to hold against the slow one [Pa].
    """

    index: int
    time: float
    wanted: float
    possible: float
    opposite: float


def slow_venting(limb: Limb, time: Vector, effective: Vector, bend: Vector) -> SlowVenting | None:
    """Return the worst of the pressures that should fall too fast, None if outlets never matter.

    Args:
        limb: calibrated limb.
        time: (F,) rising instants [s].
        effective: (F, M) wanted effective pressures [Pa].
        bend: (F, M) bend angles along the motion [rad].
    """
    air = limb.pneumatics
    if air.vent_rate == 0:
        return None
    pressure = actuation.differential_pressure(limb, time, effective, bend)
    chambers, _ = _hold_pairs(
        np.ascontiguousarray(pressure),
        np.diff(time),
        air.vent_lag,
        vent_speed(air),
        air.vent_exponent,
    )
    both = np.minimum(chambers[0], chambers[1])
    j = int(np.argmax(both.max(axis=0)))
    fall = -np.gradient(np.abs(pressure[:, j]), time)
    held = np.maximum(chambers[0, :, j], chambers[1, :, j])
    possible = air.vent_rate * (held / VENT_REFERENCE) ** air.vent_exponent
    k = int(np.argmax(fall - possible))
    return SlowVenting(
        j, float(time[k]), float(fall[k]), float(possible[k]), float(both[:, j].max())
    )


@njit(cache=True, nogil=True)
def _hold_pairs(
    wanted: Vector, steps: Vector, vent: float, rate: float, exponent: float
) -> tuple[Vector, NDArray[np.bool_]]:
    """Return the least pressures (2, F, M) of the chambers whose difference is wanted.

    Also which chamber the command has to fill (F, M): the second, or the first.
    """
    count, inputs = wanted.shape
    chambers = np.empty((2, count, inputs))
    second = np.zeros((count, inputs), dtype=np.bool_)
    for m in range(inputs):
        left, right = max(wanted[0, m], 0.0), max(-wanted[0, m], 0.0)
        for k in range(count):
            if k > 0:
                h = steps[k - 1]
                keep = np.exp(-h / vent)
                left = max(keep * left, vented(left, rate * h, exponent))
                right = max(keep * right, vented(right, rate * h, exponent))
            gap = wanted[k, m] + right - left
            second[k, m] = gap < 0.0
            left, right = left + max(gap, 0.0), right + max(-gap, 0.0)
            chambers[0, k, m], chambers[1, k, m] = left, right
    return chambers, second


def chamber_pressures(
    air: Pneumatics,
    command: ArrayLike,
    period: float,
    substeps: int,
    initial: ArrayLike | None = None,
) -> Vector:
    """Return the chambers' differential pressures (K, S, M) [Pa] in the middle of each substep.

    Args:
        air: lag, dead time and venting.
        command: (K, M) [Pa], each held for ``period`` [s].
        period: [s].
        substeps: S.
        initial: (M,) pressure at the first command, and the command before it; vented if None.
    """
    response = respond(air, command, period, substeps, initial)
    shaped: Vector = response.pressure.reshape(-1, substeps, response.pressure.shape[1])
    return shaped


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
