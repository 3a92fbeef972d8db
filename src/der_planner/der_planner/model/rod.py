"""The rod of a limb as a model, its balance of forces, and the poses in which pressures hold it.

`Balance` goes from a motion to the pressures that it needs. It projects the rod's equation of
motion, M q̈ + D q̇ − F_int − F_ext = B(q) Λ u, for configurations q̄ of evenly bent segments on the
tangent S = ∂q̄/∂(bend angles): Sᵀ B Λ u = Sᵀ(…) (virtual work).

Under gravity a rod that its pressures hold does not bend evenly. `PoseFinder` finds its resting
shape q(w) under effective pressures w by Newton's method, and w from the wanted tip r by damped
least squares on

    a² |tip(q(w)) − r|² + p² |θ(q(w)) − θ̄|²

with θ the bend angles and θ̄ a guess that decides what the tip leaves open, or with a = 0 the wanted
bend. Along a path each pose starts from the one before it, so that the branch is kept by
continuity.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model.bending import (
    PolylineKinematics,
    bend_angles,
    bend_change,
    bend_outputs,
    coordinates,
)
from der_planner.model.model import NODES, Model, Outputs, Rollout, State
from der_planner.rod import ConvergenceError, Rod, RodState
from der_planner.rod.backend import positions_of
from der_planner.rod.integration import Linearisation

_ITERATIONS = 30
_SMALL = 1e-7
"""Change of the bend angles that ends the search for a pose [rad]."""
_STRIDE = 0.2
"""Largest change of a bend angle in one iteration [rad]."""
_APPROACH = 0.01
"""Steps in which the tip is led to the first point of a path [m]."""


@dataclass(frozen=True)
class RodFirstOrder:
    """`FirstOrder` of a rod, as far as its trajectory was linearised."""

    rod: Rod
    q: Array
    linear: Linearisation

    def tangent(self, effective: Array, start: Array | None = None) -> tuple[Array, Array]:
        """Return the changes of tip and bend angles, see `FirstOrder.tangent`."""
        shift = None if start is None else (start, np.zeros_like(start))
        moved = self.linear.tangent(effective, shift)
        return moved[:, :2], bend_change(self.rod, self.q, moved[:, 2:])

    def sensitivity(self, pulse: Array | None = None) -> Array:
        """Return ∂tip/∂input, see `FirstOrder.sensitivity`."""
        moved: Array = self.linear.sensitivity(pulse)[:, :2]
        return moved


class RodModel(Model):
    """A limb's discrete elastic rod.

    Args:
        limb: the physical parameters.
        nodes: N of the rod.

    Attributes:
        rod: with all its nodes.
        kinematics: of its evenly bent segments.
    """

    name = "der"
    rest: RodState
    kinematics: PolylineKinematics

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        super().__init__(limb, nodes)
        self.rod = Rod.from_limb(limb, nodes)
        self.kinematics = PolylineKinematics(self.rod)

    @cached_property
    def balance(self) -> Balance:
        """The balance of forces of the evenly bent rod."""
        return Balance(self.rod, self.kinematics)

    def resting(self, effective: Array) -> RodState:
        """Return the rod at rest under effective pressures (M,) [Pa]."""
        return self.rod.equilibrium(effective)

    def rest_slope(self, state: RodState, effective: Array) -> Array:
        """Return ∂q/∂effective (F, M) [m/Pa] of a rod at rest, on its free rows."""
        return self.rod.linearise_equilibrium(state, effective)[self.rod.free]

    def bend_of(self, state: RodState) -> Array:
        """Return the bend angles (M,) [rad] of a state."""
        return bend_angles(self.rod, state.q)

    def state(self, angles: ArrayLike, rates: ArrayLike) -> RodState:
        """Return the rod evenly bent, at bend angles and rates (M,) [rad], [rad/s]."""
        position, velocity, _ = self.kinematics.motion(angles, rates, np.zeros(np.shape(rates)))
        return self.rod.state(coordinates(position), coordinates(velocity), like=self.rest)

    def run(
        self, start: State, effective: Array, period: float, linearise: Outputs = ""
    ) -> Rollout:
        """Simulate the rod, see `Model.run`."""
        if not isinstance(start, RodState):
            raise TypeError("the rod starts from a state of the rod, got one of the arcs")
        last = 4 * (self.rod.nodes - 1)
        outputs = [last, last + 1] + (bend_outputs(self.rod) if linearise == "all" else [])
        trajectory = self.rod.simulate(
            start,
            effective,
            period,
            substeps=effective.shape[1],
            linearise=bool(linearise),
            outputs=outputs if linearise else None,
        )
        found, q = trajectory.linearisation, trajectory.q
        linear = None if found is None else RodFirstOrder(self.rod, q, found)
        angles, tip = bend_angles(self.rod, q), trajectory.tip[:, :2]
        return Rollout(angles, tip, trajectory.final, linear)


class Balance:
    """The balance of forces of one rod.

    Args:
        rod: planar, with ghost clamp.
        kinematics: of its evenly bent segments.

    Attributes:
        moment_gain: (M,) moment of the couples of each segment per pressure [N·m/Pa].
    """

    def __init__(self, rod: Rod, kinematics: PolylineKinematics) -> None:
        self.rod = rod
        self.kinematics = kinematics
        first = [first for first, _ in rod.segments]
        self.moment_gain = rod.input_gain * rod.rest_lengths[first]

    def projected(self, q: Array, v: Array, a: Array) -> Array:
        """Return (K, M) pressures [Pa] from Sᵀ (M q̈ + D q̇ − F_int − F_ext) = Sᵀ B Λ u.

        Args:
            q: (K, M) bend angles of evenly bent segments [rad].
            v: their rates [rad/s].
            a: their accelerations [rad/s²].
        """
        force = self._needed_force(q, v, a)
        load = np.einsum("kmna,kna->km", self.kinematics.tangents(q), force)
        # A couple on an edge works on that edge's turning: Sᵀ B Λ = diag(Λ times edge length).
        pressures: Array = load / self.moment_gain
        return pressures

    def _needed_force(self, q: Array, v: Array, a: Array) -> Array:
        """Return M q̈ + D q̇ − F_int − F_ext (K, N, 2) of evenly bent configurations [N].

        Edges keep their rest length, so that F_int is that of the nodes' bending moments alone:
        with c_e = ∂E/∂ψ_e, the node behind edge e feels +c_e n̂/ē and the node ahead −c_e n̂/ē.
        """
        _, velocity, acceleration = self.kinematics.motion(q, v, a)
        mesh = self.rod.mesh
        couple = self._edge_couples(q, v)
        normal = self.kinematics.edge_normals(q) / mesh.rest[:, None]
        pair = couple[..., None] * normal
        force = mesh.swung_node_mass[:, None] * acceleration
        force -= positions_of(mesh.weight)[:, :2]
        force += mesh.node_damping[:, None] * velocity
        force[:, 1:] += pair
        force[:, :-1] -= pair
        return force

    def _edge_couples(self, q: Array, v: Array) -> Array:
        """Return c_e = ∂E/∂ψ_e (K, N−1) [N·m] with the Kelvin-Voigt moment, from κ = 2 tan(θ/2)."""
        mesh = self.rod.mesh
        # Node i turns by ψ_i − ψ_{i−1}; node 0 against the clamp.
        share = np.diff(self.kinematics.turning, axis=0, prepend=0.0)
        turn, rate = q @ share.T, v @ share.T
        kappa = 2 * np.tan(turn / 2)
        growth = 1 + kappa**2 / 4
        excess = kappa - mesh.rest_kappa[:-1, 0]
        moment = (mesh.bend[:-1] + mesh.cubic[:-1] * excess**2) * excess
        moment = (moment + mesh.viscous[:-1] * growth * rate) * growth
        ahead = np.concatenate([moment[:, 1:], np.zeros((len(q), 1))], axis=1)
        couples: Array = moment - ahead
        return couples


# Poses under gravity ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Poses:
    """K poses of a rod, each at rest under its own effective pressures.

    Attributes:
        pressures: (K, M) effective [Pa].
        states: (K,) of the rod.
        bend_angles: (K, M) [rad].
        tangents: (K, F, M) ∂q/∂pressures on the rod's free rows [m/Pa].
        misses: (K,) distance of the tip from where it was wanted [m].
        smallest_stiffness: (K,) smallest eigenvalue of the static stiffness; zero or below: the rod
            does not stay in this pose.
    """

    pressures: Array
    states: tuple[RodState, ...]
    bend_angles: Array
    tangents: Array
    misses: Array
    smallest_stiffness: Array

    def tip_by_bend(self, rod: Rod) -> Array:
        """Return ∂tip/∂bend angles (K, 2, M) [m/rad], both as pressures change them."""
        q = np.array([state.q for state in self.states])
        slope = np.zeros((*q.shape, rod.segment_count))
        slope[:, rod.free] = self.tangents
        bend = bend_change(rod, q, slope[:, bend_outputs(rod)])
        tip = slope[:, [-3, -2]]
        found = np.linalg.solve(np.swapaxes(bend, 1, 2), np.swapaxes(tip, 1, 2))
        return np.asarray(np.swapaxes(found, 1, 2), dtype=np.float64)


class PoseFinder:
    """Finds poses of one rod.

    Args:
        model: of a limb under gravity.
        prior: p [m/rad].
        tip_weight: a.
    """

    def __init__(self, model: RodModel, prior: float, tip_weight: float = 1.0) -> None:
        self._model, self.rod, self.gain = model, model.rod, model.limb.static_gain
        self.prior, self.tip_weight = prior, tip_weight
        tip = 4 * (self.rod.nodes - 1)
        self._tip = [tip, tip + 1]
        self._outputs = bend_outputs(self.rod)

    def along(self, start: RodState, tip: Array, guess: Array) -> Poses:
        """Return the poses for tips (K, 2) [m], near bend angles (K, M) [rad].

        Args:
            start: rests under no pressure; the search begins there.
            tip: wanted.
            guess: θ̄.

        Raises:
            ConvergenceError: the rod has no pose that goes on from the last one; `step` is the
                index of the point.
        """
        state, pressure = start, np.zeros(self.rod.segment_count)
        begin = state.q[self._tip]
        count = int(np.ceil(np.linalg.norm(tip[0] - begin) / _APPROACH))
        angles = self._model.bend_of(state)
        for share in np.arange(1, count) / max(count, 1):
            wanted, near = begin + share * (tip[0] - begin), angles + share * (guess[0] - angles)
            state, pressure = self._pose(state, pressure, wanted, near, 0)
        found: list[tuple[Array, RodState]] = []
        for k in range(len(tip)):
            ahead = pressure if len(found) < 2 else 2 * found[-1][0] - found[-2][0]
            try:
                state, pressure = self._pose(state, ahead, tip[k], guess[k], k)
            except ConvergenceError:
                state, pressure = self._pose(state, pressure, tip[k], guess[k], k)
            found.append((pressure, state))
        return self._described(found, tip)

    def _described(self, found: list[tuple[Array, RodState]], tip: Array) -> Poses:
        rod, q = self.rod, np.array([state.q for _, state in found])
        slopes = [rod.linearise_equilibrium(state, u)[rod.free] for u, state in found]
        return Poses(
            np.array([u for u, _ in found]),
            tuple(state for _, state in found),
            bend_angles(rod, q),
            np.array(slopes),
            np.linalg.norm(q[:, self._tip] - tip, axis=1),
            np.array([rod.smallest_stiffness(state, u) for u, state in found]),
        )

    def _pose(
        self, state: RodState, pressure: Array, tip: Array, guess: Array, index: int
    ) -> tuple[RodState, Array]:
        """Return the pose and its pressures (M,) for one tip, going there from another pose."""
        state = self._at_rest(pressure, state, index)
        misses = self._misses(state, tip, guess)
        damping = 1e-9
        for _ in range(_ITERATIONS):
            jacobian = self._jacobian(state, pressure)
            normal = jacobian.T @ jacobian
            normal[np.diag_indices(len(normal))] += damping
            change = -np.linalg.solve(normal, jacobian.T @ misses)
            change *= min(1.0, _STRIDE / max(float(np.abs(change).max()), 1e-300))
            try:
                trial = self._at_rest(pressure + change / self.gain, state, index)
            except ConvergenceError:
                damping = max(100 * damping, 1e-5)
                if damping > 1e6:
                    raise
                continue
            new = self._misses(trial, tip, guess)
            if new @ new > (misses @ misses) * (1 + 1e-12) + 1e-24:
                damping = max(10 * damping, 1e-6)
                if damping > 1e3:
                    break
                continue
            state, pressure, misses = trial, pressure + change / self.gain, new
            damping = max(damping / 10, 1e-12)
            if np.abs(change).max() < _SMALL:
                break
        return state, pressure

    def _at_rest(self, pressure: Array, start: RodState, index: int) -> RodState:
        try:
            return self.rod.equilibrium(pressure, start=start)
        except ConvergenceError as error:
            error.step = index
            raise

    def _misses(self, state: RodState, tip: Array, guess: Array) -> Array:
        angles = self._model.bend_of(state)
        missed = self.tip_weight * (state.q[self._tip] - tip)
        return np.concatenate([missed, self.prior * (angles - guess)])

    def _jacobian(self, state: RodState, pressure: Array) -> Array:
        """Return ∂misses/∂(pressures times gain) (2 + M, M)."""
        slope = self.rod.linearise_equilibrium(state, pressure) / self.gain
        q = np.tile(state.q, (slope.shape[1], 1))
        bend = bend_change(self.rod, q, slope[self._outputs].T)
        return np.concatenate([self.tip_weight * slope[self._tip], self.prior * bend.T])
