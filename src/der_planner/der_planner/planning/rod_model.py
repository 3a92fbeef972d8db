"""The rod as planners use it: evenly bent configurations, balance of forces, simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.planning.inverse import check_reach, solve
from der_planner.planning.kinematics import PolylineKinematics
from der_planner.planning.motions import Reference, resting_spline, sample_spline
from der_planner.rod import Rod, RodState

Vector = NDArray[np.float64]

NODES = 21
REFERENCE_PRIOR = 2e-3
"""Pull of the rod's bend angles toward the arcs' [m/rad]. The rod's polyline reaches a little less
far
than the arcs: the pull keeps its angles smooth where the reference touches its fold, for 0.03
mm."""

POSITION_GAIN = 20.0
"""K_p of the method ``paper`` [1/s²]."""
VELOCITY_GAIN = 8.0
"""K_d of the method ``paper`` [1/s]: with K_p a damped return at 0.7 Hz."""


class RodModel:
    """A limb's rod with the kinematics and the balance of forces of evenly bent segments.

    Args:
        limb: the physical parameters.
        nodes: N of the rod.
    """

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        self.limb = limb
        self.rod = Rod.from_limb(limb, nodes)
        self.kinematics = PolylineKinematics.of_rod(self.rod)
        self.rest = self.rod.equilibrium(np.zeros(limb.segment_count))
        first = [first for first, _ in self.rod.segments]
        self._moment_gain = self.rod.input_gain * self.rod.rest_lengths[first]

    def configuration(self, reference: Reference) -> BSpline:
        """Return the rod's bend angles (M,) [rad] as a spline of time that follows r̄(t).

        Raises:
            UnreachableError: a point is out of reach of the rod, or beyond the pressure limit.
        """
        time, tip, guess = reference.time, reference.tip, reference.bend_angles
        if self.limb.segment_count == 1:
            # One angle cannot follow two coordinates: the rod bends as the arc does.
            return resting_spline(time, guess, reference.start)
        angles, distances = solve(self.kinematics, tip, guess, REFERENCE_PRIOR)
        check_reach(self.limb, self.kinematics, time, tip, angles, distances)
        return resting_spline(time, angles, reference.start)

    def pressures(self, method: str, spline: BSpline, time: Vector) -> Vector:
        """Return effective pressures (K, M) [Pa] by ``paper`` or ``projected``.

        Args:
            method: of the two.
            spline: bend angles of evenly bent segments [rad].
            time: (K,) evenly spaced instants [s].
        """
        q, v, a = sample_spline(spline, time)
        if method == "paper":
            return self._paper_beside_the_model(q, v, a, float(time[1] - time[0]))
        return self.projected_pressures(q, v, a)

    def _paper_beside_the_model(self, q: Vector, v: Vector, a: Vector, step: float) -> Vector:
        """Return (B Λ)† (M (q̄̈ + K_d ė + K_p e) + D q̄̇ − F_int − F_ext), e from the rolled rod.

        The rod is rolled forward beside the equation, under the pressures that it has given so far,
        and its distance e from the reference comes back through the gains.
        """
        force = self._needed_force(q, v, a)[:, 1:]
        position, velocity, _ = (part[:, 1:] for part in self.kinematics.motion(q, v, a))
        inverse = np.linalg.pinv(self._input_matrix(q))
        mass = self.rod.mesh.node_mass[1:, None]
        state = self.rest if not v[0].any() else self.state(q[0], v[0])
        pressures = np.empty_like(q)
        for k in range(len(q)):
            gap = position[k] - np.column_stack([state.q[4::4], state.q[5::4]])
            rate = velocity[k] - np.column_stack([state.v[4::4], state.v[5::4]])
            wanted = force[k] + mass * (VELOCITY_GAIN * rate + POSITION_GAIN * gap)
            pressures[k] = inverse[k] @ wanted.ravel()
            state = self.rod.simulate(state, pressures[k, None], step, substeps=2).final
        return pressures

    def state(self, angles: Vector, rates: Vector) -> RodState:
        """Return the rod evenly bent, at bend angles and rates (M,) [rad], [rad/s]."""
        position, velocity, _ = self.kinematics.motion(angles, rates, np.zeros_like(rates))
        q = self.rod.straight_state().q
        v = np.zeros_like(q)
        for axis in range(2):
            q[axis::4], v[axis::4] = position[:, axis], velocity[:, axis]
        return self.rod.state(q, v, like=self.rest)

    def simulate(self, pressures: Vector, period: float, spline: BSpline | None = None) -> Vector:
        """Return the tip (K, 2) [m] at the start of each interval.

        Args:
            pressures: (K, S, M) effective pressures of each integrator step [Pa].
            period: of an interval [s].
            spline: bend angles of a motion whose beginning is the start; None: from rest.
        """
        state = self.rest if spline is None else self.state(spline(0.0), spline(0.0, 1))
        motion = self.rod.simulate(state, pressures, period, substeps=pressures.shape[1])
        tip: Vector = motion.tip[:-1, :2]
        return tip

    def projected_pressures(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return (K, M) pressures [Pa] from Sᵀ (M q̈ + D q̇ − F_int − F_ext) = Sᵀ B Λ u.

        Args:
            q: (K, M) bend angles of evenly bent segments [rad].
            v: their rates [rad/s].
            a: their accelerations [rad/s²].
        """
        force = self._needed_force(q, v, a)
        load = np.einsum("kmna,kna->km", self.kinematics.tangents(q), force)
        # A couple on an edge works on that edge's turning: Sᵀ B Λ = diag(Λ times edge length).
        pressures: Vector = load / self._moment_gain
        return pressures

    def paper_pressures(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return (K, M) pressures [Pa] from (B Λ)† (M q̈ + D q̇ − F_int − F_ext) on the free rows.

        Args:
            q: (K, M) bend angles of evenly bent segments [rad].
            v: their rates [rad/s].
            a: their accelerations [rad/s²].
        """
        force = self._needed_force(q, v, a)[:, 1:].reshape(len(q), -1)
        inputs = self._input_matrix(q)
        pressures: Vector = np.einsum("kmf,kf->km", np.linalg.pinv(inputs), force)
        return pressures

    def _needed_force(self, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return M q̈ + D q̇ − F_int − F_ext (K, N, 2) of evenly bent configurations [N].

        Edges keep their rest length, so that F_int is that of the nodes' bending moments alone:
        with c_e = ∂E/∂ψ_e, the node behind edge e feels +c_e n̂/ē and the node ahead −c_e n̂/ē.
        """
        _, velocity, acceleration = self.kinematics.motion(q, v, a)
        mesh = self.rod.mesh
        couple = self._edge_couples(q, v)
        normal = self.kinematics.edge_normals(q) / mesh.rest[:, None]
        pair = couple[..., None] * normal
        force = mesh.node_mass[:, None] * (acceleration - mesh.gravity[:2])
        force += mesh.node_damping[:, None] * velocity
        force[:, 1:] += pair
        force[:, :-1] -= pair
        return force

    def _edge_couples(self, q: Vector, v: Vector) -> Vector:
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
        couples: Vector = moment - ahead
        return couples

    def _input_matrix(self, q: Vector) -> Vector:
        """Return B Λ (K, 2(N−1), M) [N/Pa] on the free rows, those of nodes 1 … N−1."""
        rest = self.rod.rest_lengths
        normal = self.kinematics.edge_normals(q)
        matrix = np.zeros((len(q), len(rest) + 1, 2, self.limb.segment_count))
        for j, (first, count) in enumerate(self.rod.segments):
            for edge, sign in ((first, -1.0), (first + count - 2, 1.0)):
                # A couple about z on an edge: −n̂/|ē| times itself behind, +n̂/|ē| ahead.
                pair = sign * self._moment_gain[j] * normal[:, edge] / rest[edge]
                matrix[:, edge, :, j] -= pair
                matrix[:, edge + 1, :, j] += pair
        return matrix[:, 1:].reshape(len(q), -1, self.limb.segment_count)
