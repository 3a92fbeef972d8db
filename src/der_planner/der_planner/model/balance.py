"""The balance of forces of an evenly bent rod: from a motion to the pressures that it needs.

Two inverses of M q̈ + D q̇ − F_int − F_ext = B(q) Λ u, the rod's equation of motion, for
configurations q̄ of evenly bent segments: the paper's, (B Λ)† on the free rows, and the projection
on the tangent S = ∂q̄/∂(bend angles), Sᵀ B Λ u = Sᵀ(…) (virtual work).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.model.bending import PolylineKinematics
from der_planner.rod import Rod

Array = NDArray[np.float64]


class Balance:
    """The balance of forces of one rod.

    Args:
        rod: planar, with ghost clamp.
        kinematics: of its evenly bent segments.
    """

    def __init__(self, rod: Rod, kinematics: PolylineKinematics) -> None:
        self.rod = rod
        self.kinematics = kinematics
        first = [first for first, _ in rod.segments]
        self._moment_gain = rod.input_gain * rod.rest_lengths[first]

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
        pressures: Array = load / self._moment_gain
        return pressures

    def paper(self, q: Array, v: Array, a: Array) -> Array:
        """Return (K, M) pressures [Pa] from (B Λ)† (M q̈ + D q̇ − F_int − F_ext) on the free rows.

        Args:
            q: (K, M) bend angles of evenly bent segments [rad].
            v: their rates [rad/s].
            a: their accelerations [rad/s²].
        """
        force = self._needed_force(q, v, a)[:, 1:].reshape(len(q), -1)
        pressures: Array = np.einsum("kmf,kf->km", self.inverse_inputs(q), force)
        return pressures

    def inverse_inputs(self, q: Array) -> Array:
        """Return (B Λ)† (K, M, 2(N−1)) [Pa/N] on the free rows of nodes 1 … N−1."""
        return np.asarray(np.linalg.pinv(self._input_matrix(q)), dtype=np.float64)

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
        force -= mesh.node_mass[:, None] * mesh.gravity[:2]
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

    def _input_matrix(self, q: Array) -> Array:
        """Return B Λ (K, 2(N−1), M) [N/Pa] on the free rows, those of nodes 1 … N−1."""
        rest = self.rod.rest_lengths
        normal = self.kinematics.edge_normals(q)
        matrix = np.zeros((len(q), len(rest) + 1, 2, self.rod.segment_count))
        for j, (first, count) in enumerate(self.rod.segments):
            for edge, sign in ((first, -1.0), (first + count - 2, 1.0)):
                # A couple about z on an edge: −n̂/|ē| times itself behind, +n̂/|ē| ahead.
                pair = sign * self._moment_gain[j] * normal[:, edge] / rest[edge]
                matrix[:, edge, :, j] -= pair
                matrix[:, edge + 1, :, j] += pair
        return matrix[:, 1:].reshape(len(q), -1, self.rod.segment_count)
