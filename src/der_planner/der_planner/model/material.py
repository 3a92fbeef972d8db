"""The material's law: from chamber pressures to the pressure that a linear limb would have to feel.

A calibrated segment has chambers of unequal gain, grows stiffer with pressure, rubs and creeps. The
rod and the arcs stay linear and without memory: they are driven by an *effective* pressure w, which
bends them as the differential pressure u bends the limb,

    w_i (1 + s |u_i|) = u_i (1 + a sgn u_i) + Σ_j c_ij u_j − (F z + C q) / G
    θ_f dz = (1 − z sgn dθ) dθ          Dahl friction, −1 < z < 1 (Dahl 1968, exponent 1)
    q̇ = κ̇ − q / τ                       Maxwell creep

with θ the bend angle [rad], κ = θ / L, and c the coupling to the neighbours' pressures. A limb that
has rested starts with z = q = 0; `Memory` carries them on from an earlier instant. A cubic
stiffness belongs to the models themselves, which take it from the limb.

Friction and creep act along a bend history that is known (that of a planned motion), or along the
bend at rest under the pressures (`resting_bend`), which needs no measured angle: the limb's swing
about it is small and fast and hardly changes them.
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model.resting import RestingLaw, change_along, rest_along, weight_of

_COUPLING_ROUNDS = 60
"""At the most; each leaves the coupling's share of what was left, usually some per cent."""
_SAME_PRESSURE = 1e-6
"""[Pa] change below which the neighbours' pressures are known."""


class Memory(NamedTuple):
    """What friction and creep remember at one instant, (M,) each, or at K instants, (K, M) each.

    Attributes:
        bend: bend angle [rad].
        friction: z of each Dahl element, −1 … 1.
        creep: q, strain of each Maxwell element's spring [1/m].
    """

    bend: Array
    friction: Array
    creep: Array

    def at(self, index: int) -> Memory:
        """Return what is remembered at one of the instants, to go on from there."""
        return Memory(*(part[index] for part in self))


class Material:
    """The material of one limb.

    Args:
        limb: calibrated limb.

    Attributes:
        has_memory: whether it rubs or creeps.
    """

    def __init__(self, limb: Limb) -> None:
        segments = limb.segments
        self._limb, self._segments, self._count = limb, segments, limb.segment_count
        self._asymmetry = np.array([s.gain_asymmetry for s in segments])
        self._stiffening = np.array([s.pressure_stiffening for s in segments])
        self._coupling = _coupling_matrix(limb)
        self.has_memory = any(s.friction_moment > 0 or s.creep_stiffness > 0 for s in segments)

    # Along a known bend ------------------------------------------------------------------------

    def differential_pressure(self, time: Array, effective: Array, bend_angle: Array) -> Array:
        """Return the differential pressures (K, M) [Pa] that make a limb feel effective ones.

        Args:
            time: (K,) rising [s].
            effective: (K, M) what the linear model wants [Pa].
            bend_angle: (K, M) bend along the motion [rad].

        Raises:
            ValueError: the stiffening makes a pressure unreachable.
        """
        driven = effective + self.memory_pressures(time, bend_angle)
        result = np.zeros_like(effective)
        # The neighbours' pressures are known but for what their neighbours change: a contraction.
        for _ in range(_COUPLING_ROUNDS):
            before = result
            load = driven - before @ self._coupling.T
            # w (1 + s |u|) = u (1 + a sgn u) − load + w is linear on either side of zero.
            side = np.sign(load)
            slope = 1.0 + self._asymmetry * side
            slope -= self._stiffening * effective * side
            stiff = ~np.all(slope > 0.1, axis=0)
            if stiff.any():
                index = int(np.argmax(stiff))
                raise ValueError(
                    f"segment {index} is too stiff for an effective pressure of "
                    f"{np.abs(effective[:, index]).max():.0f} Pa: check its pressure_stiffening"
                )
            result = load / slope
            if np.abs(result - before).max(initial=0.0) < _SAME_PRESSURE:
                break
        return result

    def without_memory(self, differential: Array, memory: Array) -> Array:
        """Return effective pressures w (…, M) [Pa] where friction and creep are known.

        Args:
            differential: (…, M) pressures in the chambers [Pa].
            memory: (…, M) pressure that friction and creep take [Pa].
        """
        driven, stiffer, _, _ = self._drive(differential)
        effective: Array = (driven - memory) / stiffer
        return effective

    def slopes(self, differential: Array, effective: Array) -> Array:
        """Return ∂w_i/∂u_j (…, M, M) where the bend is known: no instant changes another.

        Args:
            differential: (…, M) pressures in the chambers [Pa].
            effective: (…, M) what they became [Pa].
        """
        _, stiffer, gain, stiffening = self._drive(differential)
        own = (gain - stiffening * effective) / stiffer
        slopes: Array = self._coupling / stiffer[..., None] + own[..., None] * np.eye(self._count)
        return slopes

    def _drive(self, differential: Array) -> tuple[Array, Array, Array, Array]:
        """Return u (1 + a sgn u) + Σ c u [Pa], 1 + s |u|, and their slopes by the own u, (…, M)."""
        side = np.sign(differential)
        gain = 1.0 + self._asymmetry * side
        driven = differential * gain + differential @ self._coupling.T
        stiffer = 1.0 + self._stiffening * np.abs(differential)
        return driven, stiffer, gain, self._stiffening * side

    # What friction and creep remember ----------------------------------------------------------

    def remember(self, time: Array, bend_angle: Array, start: Memory | None = None) -> Memory:
        """Return z and q along bend histories (K, M) [rad] from a start on; None: a rested limb."""
        friction, creep = np.zeros_like(bend_angle), np.zeros_like(bend_angle)
        for index, segment in enumerate(self._segments):
            angle = np.ascontiguousarray(bend_angle[:, index])
            z, q = (0.0, 0.0) if start is None else (start.friction[index], start.creep[index])
            if segment.friction_moment > 0:
                friction[:, index] = dahl(angle, segment.friction_curvature * segment.length, z)
            if segment.creep_stiffness > 0:
                creep[:, index] = maxwell(time, angle / segment.length, segment.creep_time, q)
        return Memory(bend_angle, friction, creep)

    def pressure_taken(self, history: Memory) -> Array:
        """Return the (K, M) pressures that friction and creep take, by what they remember [Pa]."""
        columns = [
            (s.friction_moment * history.friction[:, i] + s.creep_stiffness * history.creep[:, i])
            / s.moment_gain
            for i, s in enumerate(self._segments)
        ]
        return np.column_stack(columns)

    def memory_pressures(self, time: Array, bend_angle: Array) -> Array:
        """Return the (K, M) pressures that friction and creep take of a limb that has rested [Pa].

        Args:
            time: (K,) rising [s].
            bend_angle: (K, M) [rad].
        """
        return self.pressure_taken(self.remember(time, bend_angle))

    # Along the bend at rest --------------------------------------------------------------------

    def slow(self, time: Array, differential: Array) -> Array:
        """Return effective pressures (K, M) [Pa] of chamber pressures (K, M) [Pa] alone.

        Friction and creep act along the bend of `resting_bend`.
        """
        taken = self.memory_pressures(time, self.resting_bend(time, differential))
        return self.without_memory(differential, taken)

    def resting_bend(self, time: ArrayLike, differential: ArrayLike) -> Array:
        """Return the bend angles (K, M) [rad] of a slow motion under chamber pressures [Pa].

        Without inertia each segment bends by its own moment and the limb's weight; friction and
        creep are solved for at each instant together with the bend, since they act along it. The
        limb has rested under the first pressures.

        Args:
            time: (K,) rising [s].
            differential: (K, M) [Pa].
        """
        driven, stiffer, _, _ = self._drive(np.asarray(differential, dtype=float))
        bend: Array = rest_along(
            np.ascontiguousarray(time, dtype=float),
            np.ascontiguousarray(driven),
            np.ascontiguousarray(stiffer),
            self.resting_law,
        )
        return bend

    def slow_change(self, time: Array, differential: Array, change: Array) -> Array:
        """Return the first-order change (K, M) of the effective pressures along the bend at rest.

        Args:
            time: (K,) [s].
            differential: (K, M) in the chambers [Pa].
            change: (K, M) of them [Pa].
        """
        bend = self.resting_bend(time, differential)
        effective = self.without_memory(differential, self.memory_pressures(time, bend))
        _, stiffer, gain, stiffening = self._drive(differential)
        moved = change * gain + change @ self._coupling.T - effective * change * stiffening
        law = self.resting_law
        pushed = (law.gain * moved / stiffer)[..., None]
        _, taken_by = change_along(np.ascontiguousarray(time), stiffer, bend, law, pushed)
        result: Array = (moved - taken_by[..., 0]) / stiffer
        return result

    def driven_bend(
        self, time: Array, differential: Array, bend: Array, along: Array | None = None
    ) -> Array:
        """Return what pressures, friction and creep bend (K, M) beside the elastic moment [rad].

        Where it is less the weight's share, the bend is that of a limb at rest.

        Args:
            time: (K,) [s].
            differential: (K, M) in the chambers [Pa].
            bend: (K, M) of the limb [rad].
            along: (K, M) bend along which friction and creep act [rad]; None: the same.
        """
        law, bent = self.resting_law, bend - self.resting_law.rest
        taken = self.memory_pressures(time, bend if along is None else along)
        effective = self.without_memory(differential, taken)
        beside: Array = law.gain * effective - bent - law.cubic * bent**3
        return beside

    def resting_bend_change(
        self, time: Array, differential: Array, bend: Array, driven: Array
    ) -> Array:
        """Return the first-order changes (K, M, P) of a bend at rest [rad].

        Args:
            time: (K,) [s].
            differential: (K, M) in the chambers [Pa].
            bend: (K, M) found by `resting_bend` [rad].
            driven: (K, M, P) changes of `driven_bend` [rad].
        """
        _, stiffer, _, _ = self._drive(differential)
        change: Array = change_along(
            np.ascontiguousarray(time), stiffer, bend, self.resting_law, driven
        )[0]
        return change

    def weight_torques(self, bend_angle: Array) -> Array:
        """Return the torques (K, M) of the weight on the bend angles (K, M) [N·m]."""
        weight = self.resting_law.weight
        heading = bend_angle @ weight.turning.T
        x, y = weight.gravity
        turns = weight.lever * (y * np.cos(heading) - x * np.sin(heading))
        torque: Array = turns @ weight.turning
        return torque

    @cached_property
    def resting_law(self) -> RestingLaw:
        """What the bend at rest depends on."""
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
            for s in self._segments
        ]
        return RestingLaw._make([*np.array(columns).T.copy(), weight_of(self._limb)])


def _coupling_matrix(limb: Limb) -> Array:
    """Return c (M, M): moment on segment i by pressure j, over that of its own [-]."""
    before = np.diag([segment.coupling_before for segment in limb.segments[1:]], -1)
    return before + np.diag([segment.coupling_after for segment in limb.segments[:-1]], 1)


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
