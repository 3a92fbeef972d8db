"""Between the pressure in the chambers and the pressure that a memoryless, linear limb feels.

A segment that was calibrated has chambers of unequal gain, grows stiffer with pressure, rubs and
creeps. Along a motion whose bend is known, all of that is a known pressure, so that the planners
may stay with a linear rod driven by an *effective* pressure w and convert at the end:

    w_i (1 + s |u_i|) = u_i (1 + a sgn u_i) + Σ_j c_ij u_j − (F z + C q) / G
    θ_f dz = (1 − z sgn dθ) dθ          Dahl friction, −1 < z < 1
    q̇ = κ̇ − q / τ                       Maxwell creep

with u the differential pressure [Pa], θ the bend angle, κ = θ / L, and c the coupling to the
neighbours' pressures. All memory starts at zero: a limb that has rested. A cubic stiffness belongs
to the models themselves, which take it from the limb.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb, Segment

Array = NDArray[np.float64]

_COUPLING_ROUNDS = 60
"""At the most; each leaves the coupling's share of what was left, usually some per cent."""
_SAME_PRESSURE = 1e-6
"""[Pa] change below which the neighbours' pressures are known."""


def differential_pressure(
    limb: Limb, time: ArrayLike, effective: ArrayLike, bend_angle: ArrayLike
) -> Array:
    """Return the differential pressures that make a limb feel these effective ones.

    Args:
        limb: calibrated limb.
        time: (K,) rising [s].
        effective: (K, M) what the linear model wants [Pa].
        bend_angle: (K, M) bend along the motion [rad].

    Returns:
        (K, M) [Pa].

    Raises:
        ValueError: shapes do not fit, or the stiffening makes a pressure unreachable.
    """
    times, wanted, angles = _check(limb, time, effective, bend_angle)
    held = wanted + memory_pressures(limb, times, angles)
    coupling = coupling_matrix(limb)
    result = np.zeros_like(wanted)
    # The neighbours' pressures are known but for what their own neighbours change: a contraction.
    for _ in range(_COUPLING_ROUNDS if coupling.any() else 1):
        before = result.copy()
        load = held - before @ coupling.T
        for index, segment in enumerate(limb.segments):
            result[:, index] = _own_pressure(segment, index, load[:, index], wanted[:, index])
        if np.abs(result - before).max(initial=0.0) < _SAME_PRESSURE:
            break
    return result


def _own_pressure(segment: Segment, index: int, load: Array, wanted: Array) -> Array:
    """Return u (K,) [Pa] of w (1 + s |u|) = u (1 + a sgn u) − load + w, linear on either side."""
    side = np.sign(load)
    slope = 1.0 + segment.gain_asymmetry * side
    slope = slope - segment.pressure_stiffening * wanted * side
    if not np.all(slope > 0.1):
        raise ValueError(
            f"segment {index} is too stiff for an effective pressure of "
            f"{np.abs(wanted).max():.0f} Pa: check its pressure_stiffening"
        )
    pressure: Array = load / slope
    return pressure


def effective_pressure(
    limb: Limb, time: ArrayLike, differential: ArrayLike, bend_angle: ArrayLike
) -> Array:
    """Return the (K, M) effective pressures [Pa] of measured ones; the inverse of the above."""
    times, measured, angles = _check(limb, time, differential, bend_angle)
    return without_memory(limb, measured, memory_pressures(limb, times, angles))[0]


def without_memory(limb: Limb, differential: Array, memory: Array) -> tuple[Array, Array]:
    """Return effective pressures w [Pa] and their slopes ∂w_i/∂u_i at a known memory pressure.

    Args:
        limb: calibrated limb.
        differential: (..., M) pressures in the chambers [Pa].
        memory: (..., M) what friction and creep take [Pa].
    """
    asymmetry = np.array([s.gain_asymmetry for s in limb.segments])
    stiffening = np.array([s.pressure_stiffening for s in limb.segments])
    side = np.sign(differential)
    driven = differential * (1.0 + asymmetry * side) + differential @ coupling_matrix(limb).T
    stiffer = 1.0 + stiffening * np.abs(differential)
    effective = (driven - memory) / stiffer
    return effective, (1.0 + asymmetry * side - stiffening * side * effective) / stiffer


def coupling_matrix(limb: Limb) -> Array:
    """Return c (M, M): moment on segment i by pressure j, over that of its own [-]."""
    count = limb.segment_count
    matrix = np.zeros((count, count))
    for index, segment in enumerate(limb.segments):
        if index > 0:
            matrix[index, index - 1] = segment.coupling_before
        if index < count - 1:
            matrix[index, index + 1] = segment.coupling_after
    return matrix


def memory_pressures(limb: Limb, time: Array, bend_angle: Array) -> Array:
    """Return the (K, M) pressures that friction and creep take along bend histories (K, M) [Pa]."""
    columns = [
        memory_pressure(segment, time, bend_angle[:, index])
        for index, segment in enumerate(limb.segments)
    ]
    return np.column_stack(columns)


def memory_pressure(segment: Segment, time: Array, bend_angle: Array) -> Array:
    """Return the (K,) pressure that friction and creep take along a bend history (K,) [Pa]."""
    total = np.zeros_like(time)
    if segment.friction_moment > 0:
        turn = segment.friction_curvature * segment.length
        total += segment.friction_moment * dahl(bend_angle, turn)
    if segment.creep_stiffness > 0:
        strain = maxwell(time, bend_angle / segment.length, segment.creep_time)
        total += segment.creep_stiffness * strain
    pressure: Array = total / segment.moment_gain
    return pressure


@njit(cache=True)  # type: ignore[untyped-decorator]
def dahl(angle: Array, turn: float) -> Array:
    """Return z (K,) of a Dahl element along an angle (K,) [rad], exact for straight pieces."""
    z = np.zeros(angle.shape[0])
    for k in range(1, angle.shape[0]):
        change = angle[k] - angle[k - 1]
        sign = 1.0 if change >= 0.0 else -1.0
        z[k] = sign + (z[k - 1] - sign) * np.exp(-abs(change) / turn)
    return z


@njit(cache=True)  # type: ignore[untyped-decorator]
def maxwell(time: Array, strain: Array, relaxation: float) -> Array:
    """Return the strain (K,) of the spring of a Maxwell element, exact for straight pieces."""
    q = np.zeros(strain.shape[0])
    for k in range(1, strain.shape[0]):
        rate = (time[k] - time[k - 1]) / relaxation
        keep = np.exp(-rate)
        q[k] = q[k - 1] * keep + (strain[k] - strain[k - 1]) * (1.0 - keep) / rate
    return q


def slow_effective_pressure(limb: Limb, time: ArrayLike, differential: ArrayLike) -> Array:
    """Return effective pressures (K, M) [Pa] of chamber pressures (K, M) [Pa] alone.

    Friction and creep see the bend of `resting_bend`: what swings around it hardly changes them.
    """
    return effective_pressure(limb, time, differential, resting_bend(limb, time, differential))


def resting_bend(limb: Limb, time: ArrayLike, differential: ArrayLike) -> Array:
    """Return the bend angles (K, M) [rad] of a slow motion under chamber pressures (K, M) [Pa].

    Without inertia each segment bends by its own moment alone; friction and creep are solved for at
    each instant together with the bend, since they act along it.
    """
    times = np.ascontiguousarray(time, dtype=float)
    pressures = np.asarray(differential, dtype=float)
    bend = np.empty_like(pressures)
    crossed = pressures @ coupling_matrix(limb).T
    for index, segment in enumerate(limb.segments):
        u = pressures[:, index]
        stiffer = 1.0 + segment.pressure_stiffening * np.abs(u)
        driven = u * (1.0 + segment.gain_asymmetry * np.sign(u)) + crossed[:, index]
        bend[:, index] = _follow(
            times,
            np.ascontiguousarray(driven),
            np.ascontiguousarray(stiffer),
            float(limb.static_gain[index]),
            segment.cubic_stiffness / segment.bending_stiffness / segment.length**2,
            segment.rest_curvature * segment.length,
            segment.friction_moment / segment.moment_gain,
            max(segment.friction_curvature * segment.length, 1e-6),
            segment.creep_stiffness / segment.length / segment.moment_gain,
            max(segment.creep_time, 1e-6),
        )
    return bend


@njit(cache=True)  # type: ignore[untyped-decorator]
def _follow(
    time: Array,
    driven: Array,
    stiffer: Array,
    gain: float,
    cubic: float,
    rest: float,
    friction: float,
    turn: float,
    creep: float,
    relaxation: float,
) -> Array:
    """Solve the bend against stiffness, friction and creep at each instant by Newton's method.

    With φ = θ − rest, φ + cubic φ³ = gain (driven − friction z − creep q) / stiffer. The residual
    rises with θ, bending away from the last angle stiffens it: one root, on the side to which it
    points at the last angle.
    """
    bend = np.empty(time.shape[0])
    linear = gain * driven[0] / stiffer[0]
    angle = rest + linear
    for _ in range(20):
        bent = angle - rest
        angle -= (bent + cubic * bent**3 - linear) / (1.0 + 3.0 * cubic * bent**2)
    bend[0] = angle
    z, q = 0.0, 0.0
    for k in range(1, time.shape[0]):
        rate = (time[k] - time[k - 1]) / relaxation
        keep = np.exp(-rate)
        share = (1.0 - keep) / rate
        last = angle
        scale = gain / stiffer[k]
        bent = last - rest
        error = bent + cubic * bent**3 - scale * (driven[k] - friction * z - creep * q * keep)
        sign = -1.0 if error > 0.0 else 1.0
        for _ in range(30):
            change = angle - last
            fade = np.exp(-abs(change) / turn)
            moved = sign + (z - sign) * fade
            load = friction * moved + creep * (q * keep + change * share)
            bent = angle - rest
            error = bent + cubic * bent**3 - scale * (driven[k] - load)
            slope = 1.0 + 3.0 * cubic * bent**2
            slope += scale * (friction * (1.0 - z * sign) * fade / turn + creep * share)
            step = error / slope
            angle -= step
            if (angle - last) * sign < 0.0:
                angle = last
            if abs(step) < 1e-12:
                break
        change = angle - last
        z = sign + (z - sign) * np.exp(-abs(change) / turn)
        q = q * keep + change * share
        bend[k] = angle
    return bend


def lead(limb: Limb, time: ArrayLike, differential: ArrayLike, largest_step: float = 0.02) -> Array:
    """Return the commands (K, M) that put these pressures (K, M) into the chambers in time [Pa].

    The inverse of a dead time and a first-order lag, with one time constant while |pressure|
    rises and another while it falls.
    """
    times = np.asarray(time, dtype=float)
    wanted = np.asarray(differential, dtype=float)
    air = limb.pneumatics
    result = np.empty_like(wanted)
    half = 0.5 * largest_step
    for index in range(wanted.shape[1]):
        column = wanted[:, index]
        ahead = times + air.delay
        value = np.interp(ahead, times, column)
        slope = np.interp(ahead + half, times, column) - np.interp(ahead - half, times, column)
        slope /= largest_step
        lag = np.where(value * slope >= 0, air.time_constant, air.vent_lag)
        result[:, index] = value + lag * slope
    limit = air.pressure_limit
    clipped: Array = np.clip(result, -limit, limit)
    return clipped


def _check(
    limb: Limb, time: ArrayLike, pressure: ArrayLike, bend_angle: ArrayLike
) -> tuple[Array, Array, Array]:
    times = np.asarray(time, dtype=float)
    pressures = np.asarray(pressure, dtype=float)
    angles = np.asarray(bend_angle, dtype=float)
    expected = (times.size, limb.segment_count)
    if times.ndim != 1 or pressures.shape != expected or angles.shape != expected:
        raise ValueError(
            f"expected time (K,), pressures and bend angles (K, {limb.segment_count}); got "
            f"{times.shape}, {pressures.shape}, {angles.shape}"
        )
    return times, pressures, angles
