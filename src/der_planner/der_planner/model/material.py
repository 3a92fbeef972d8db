"""The material's law: from chamber pressures to the pressure that a linear limb would have to feel.

A calibrated segment has chambers of unequal gain, grows stiffer with pressure, rubs and creeps. The
rod and the arcs stay linear and without memory: they are driven by an *effective* pressure w, which
bends them as the differential pressure u bends the limb,

    w_i (1 + s |u_i|) = u_i (1 + a sgn u_i) + Σ_j c_ij u_j − (F z + C q) / G
    θ_f dz = (1 − z sgn dθ) dθ          Dahl friction, −1 < z < 1 (Dahl 1968, exponent 1)
    q̇ = κ̇ − q / τ                       Maxwell creep

with θ the bend angle [rad], κ = θ / L, and c the coupling to the neighbours' pressures. A limb that
has rested starts with z = q = 0; `Memory` carries them on from an earlier simulation. A cubic
stiffness belongs to the models themselves, which take it from the limb.

Friction and creep act along a bend history that is known (that of a planned motion), or along the
bend at rest under the pressures (`resting_bend`), which needs no measured angle: the limb's swing
about it is small and fast and hardly changes them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb, Segment
from der_planner.model.resting import RestingLaw, RestingSlopes, rest_along, rest_slopes
from der_planner.model.sag import weight_of

Array = NDArray[np.float64]

_COUPLING_ROUNDS = 60
"""At the most; each leaves the coupling's share of what was left, usually some per cent."""
_SAME_PRESSURE = 1e-6
"""[Pa] change below which the neighbours' pressures are known."""


@dataclass(frozen=True)
class Memory:
    """What friction and creep remember at one instant.

    Attributes:
        bend: (M,) bend angle at that instant [rad].
        friction: (M,) z of each Dahl element, −1 … 1.
        creep: (M,) q, strain of each Maxwell element's spring [1/m].
    """

    bend: Array
    friction: Array
    creep: Array


# Along a known bend ----------------------------------------------------------------------------


def differential_pressure(
    limb: Limb, time: ArrayLike, effective: ArrayLike, bend_angle: ArrayLike
) -> Array:
    """Return the differential pressures (K, M) [Pa] that make a limb feel these effective ones.

    Args:
        limb: calibrated limb.
        time: (K,) rising [s].
        effective: (K, M) what the linear model wants [Pa].
        bend_angle: (K, M) bend along the motion [rad].

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
    """Return the (K, M) effective pressures [Pa] of chamber pressures (K, M) along a known bend.

    The inverse of `differential_pressure`, with the same arguments.
    """
    times, measured, angles = _check(limb, time, differential, bend_angle)
    return without_memory(limb, measured, memory_pressures(limb, times, angles))


def without_memory(limb: Limb, differential: Array, memory: Array) -> Array:
    """Return effective pressures w (…, M) [Pa] where friction and creep are known.

    Args:
        limb: calibrated limb.
        differential: (…, M) pressures in the chambers [Pa].
        memory: (…, M) pressure that friction and creep take [Pa].
    """
    driven, stiffer, _, _ = _drive(limb, differential)
    effective: Array = (driven - memory) / stiffer
    return effective


def _drive(limb: Limb, differential: Array) -> tuple[Array, Array, Array, Array]:
    """Return u (1 + a sgn u) + Σ c u [Pa], 1 + s |u|, and their slopes by the own u, all (…, M)."""
    asymmetry = np.array([s.gain_asymmetry for s in limb.segments])
    stiffening = np.array([s.pressure_stiffening for s in limb.segments])
    side = np.sign(differential)
    gain = 1.0 + asymmetry * side
    driven = differential * gain + differential @ coupling_matrix(limb).T
    return driven, 1.0 + stiffening * np.abs(differential), gain, stiffening * side


@dataclass(frozen=True)
class Slopes:
    """∂w/∂u of effective pressures where the bend is known: no instant changes another.

    Attributes:
        own: (…, M) ∂w_i/∂u_i without the coupling.
        crossed: (…, M, M) ∂w_i/∂u_j by the coupling alone; zero for i = j.
    """

    own: Array
    crossed: Array

    @property
    def matrix(self) -> Array:
        """(…, M, M) ∂w_i/∂u_j."""
        return self.crossed + self.own[..., None] * np.eye(self.own.shape[-1])

    def tangent(self, change: Array) -> Array:
        """Return the change (…, M) of the effective pressures by one of the chambers' (…, M)."""
        moved: Array = np.einsum("...ij,...j->...i", self.matrix, change)
        return moved

    def adjoint(self, weight: Array) -> Array:
        """Return Σ weight · ∂w/∂u (…, M), the transpose of `tangent`, for weights (…, M)."""
        gradient: Array = np.einsum("...ij,...i->...j", self.matrix, weight)
        return gradient


def slopes(limb: Limb, differential: Array, effective: Array) -> Slopes:
    """Return ∂w/∂u at differential pressures and the effective ones they became, (…, M) [Pa]."""
    _, stiffer, gain, stiffening = _drive(limb, differential)
    own = (gain - stiffening * effective) / stiffer
    return Slopes(own, coupling_matrix(limb) / stiffer[..., None])


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


def memory_pressures(
    limb: Limb, time: Array, bend_angle: Array, start: Memory | None = None
) -> Array:
    """Return the (K, M) pressures that friction and creep take along bend histories (K, M) [Pa].

    Args:
        limb: calibrated limb.
        time: (K,) rising [s].
        bend_angle: (K, M) [rad].
        start: what they remember at ``time[0]``; None: a limb that has rested.
    """
    return taken_by(limb, remember(limb, time, bend_angle, start))


def taken_by(limb: Limb, history: MemoryHistory) -> Array:
    """Return the (K, M) pressures that friction and creep take, from what they remember [Pa]."""
    columns = []
    for index, segment in enumerate(limb.segments):
        total = np.zeros(len(history.bend))
        if segment.friction_moment > 0:
            total += segment.friction_moment * history.friction[:, index]
        if segment.creep_stiffness > 0:
            total += segment.creep_stiffness * history.creep[:, index]
        columns.append(total / segment.moment_gain)
    return np.column_stack(columns)


class MemoryHistory(NamedTuple):
    """Bend angle [rad], friction's z and creep's strain q [1/m] of K instants, each (K, M)."""

    bend: Array
    friction: Array
    creep: Array

    def at(self, index: int) -> Memory:
        """Return what is remembered at one of the instants, to go on from there."""
        return Memory(self.bend[index], self.friction[index], self.creep[index])


def remember(
    limb: Limb, time: Array, bend_angle: Array, start: Memory | None = None
) -> MemoryHistory:
    """Return z and q along bend histories (K, M) [rad]; arguments as of `memory_pressures`."""
    friction, creep = np.zeros_like(bend_angle), np.zeros_like(bend_angle)
    for index, segment in enumerate(limb.segments):
        angle = np.ascontiguousarray(bend_angle[:, index])
        z, q = (0.0, 0.0) if start is None else (start.friction[index], start.creep[index])
        if segment.friction_moment > 0:
            friction[:, index] = dahl(angle, segment.friction_curvature * segment.length, z)
        if segment.creep_stiffness > 0:
            creep[:, index] = maxwell(time, angle / segment.length, segment.creep_time, q)
    return MemoryHistory(bend_angle, friction, creep)


@njit(cache=True)
def dahl(angle: Array, turn: float, start: float = 0.0) -> Array:
    """Return z (K,) of a Dahl element along an angle (K,) [rad], exact for straight pieces."""
    z = np.empty(angle.shape[0])
    z[0] = start
    for k in range(1, angle.shape[0]):
        change = angle[k] - angle[k - 1]
        sign = 1.0 if change >= 0.0 else -1.0
        z[k] = sign + (z[k - 1] - sign) * np.exp(-abs(change) / turn)
    return z


@njit(cache=True)
def maxwell(time: Array, strain: Array, relaxation: float, start: float = 0.0) -> Array:
    """Return the strain (K,) of the spring of a Maxwell element, exact for straight pieces."""
    q = np.empty(strain.shape[0])
    q[0] = start
    for k in range(1, strain.shape[0]):
        rate = (time[k] - time[k - 1]) / relaxation
        keep = np.exp(-rate)
        q[k] = q[k - 1] * keep + (strain[k] - strain[k - 1]) * (1.0 - keep) / rate
    return q


# Along the bend at rest ------------------------------------------------------------------------


def slow_effective_pressure(limb: Limb, time: ArrayLike, differential: ArrayLike) -> Array:
    """Return effective pressures (K, M) [Pa] of chamber pressures (K, M) [Pa] alone.

    Friction and creep act along the bend of `resting_bend`.
    """
    return effective_pressure(limb, time, differential, resting_bend(limb, time, differential))


def resting_bend(
    limb: Limb, time: ArrayLike, differential: ArrayLike, start: Memory | None = None
) -> Array:
    """Return the bend angles (K, M) [rad] of a slow motion under chamber pressures (K, M) [Pa].

    Without inertia each segment bends by its own moment and the limb's weight; friction and creep
    are solved for at each instant together with the bend, since they act along it.

    Args:
        limb: calibrated limb.
        time: (K,) rising [s].
        differential: (K, M) [Pa].
        start: bend and memory at ``time[0]``; None: at rest under the first pressures, without any.
    """
    times = np.ascontiguousarray(time, dtype=float)
    pressures = np.asarray(differential, dtype=float)
    driven, stiffer, _, _ = (np.ascontiguousarray(part) for part in _drive(limb, pressures))
    bend: Array = rest_along(times, driven, stiffer, resting_law(limb), _begin(limb, start))
    return bend


def _begin(limb: Limb, start: Memory | None) -> Array:
    """Return bend [rad], z and creep [rad] of each segment (M, 3) at the start; NaN: at rest."""
    if start is None:
        return np.full((limb.segment_count, 3), np.nan)
    lengths = np.array([s.length for s in limb.segments])
    return np.stack([start.bend, start.friction, start.creep * lengths], axis=1)


def resting_law(limb: Limb) -> RestingLaw:
    """Return what the bend at rest depends on."""
    columns = [
        (
            s.static_gain,
            s.cubic_stiffness / s.bending_stiffness / s.length**2,
            s.rest_curvature * s.length,
            s.friction_moment / s.moment_gain,
            max(s.friction_curvature * s.length, 1e-6),
            s.creep_stiffness / s.length / s.moment_gain,
            max(s.creep_time, 1e-6),
            s.bending_stiffness / s.length,
        )
        for s in limb.segments
    ]
    gain, cubic, rest, friction, turn, creep, relaxation, stiffness = np.array(columns).T.copy()
    return RestingLaw(
        gain, cubic, rest, friction, turn, creep, relaxation, stiffness, weight_of(limb)
    )


class SlowSlopes:
    """∂w/∂u of effective pressures along the bend at rest, where each instant changes later ones.

    Args:
        limb: calibrated limb.
        time: (K,) [s].
        differential: (K, M) [Pa].
        effective: (K, M) of `slow_effective_pressure` [Pa].
        start: as of `resting_bend`.
    """

    def __init__(
        self,
        limb: Limb,
        time: Array,
        differential: Array,
        effective: Array,
        start: Memory | None = None,
    ) -> None:
        self._effective = effective
        _, self._stiffer, self._gain, self._stiffening = _drive(limb, differential)
        self._coupling = coupling_matrix(limb)
        law = resting_law(limb)
        bend = resting_bend(limb, time, differential, start)
        times = np.ascontiguousarray(time)
        steps = rest_slopes(times, self._stiffer, bend, law, _begin(limb, start))
        self._memory = RestingSlopes(law, steps)

    def tangent(self, change: Array) -> Array:
        """Return the change (K, M) of the effective pressures by one of the chambers' (K, M)."""
        driven = change * self._gain + change @ self._coupling.T
        stiffer = change * self._stiffening
        memory = self._memory.tangent(driven, stiffer)
        moved: Array = (driven - memory - self._effective * stiffer) / self._stiffer
        return moved

    def adjoint(self, weight: Array) -> Array:
        """Return Σ weight · ∂w/∂u (K, M), the transpose of `tangent`, for weights (K, M)."""
        scaled = weight / self._stiffer
        by_driven, by_stiffer = self._memory.adjoint(scaled)
        driven = scaled - by_driven
        stiffer = -scaled * self._effective - by_stiffer
        gradient: Array = driven * self._gain + driven @ self._coupling
        return gradient + stiffer * self._stiffening


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
