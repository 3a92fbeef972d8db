"""The rod as the planners use it: evenly bent reference configurations, force balance, simulation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.planning.inverse import check_reach, solve
from der_planner.planning.kinematics import PolylineKinematics
from der_planner.planning.motions import Reference, resting_spline
from der_planner.rod import Rod

Vector = NDArray[np.float64]

NODES = 21
REFERENCE_PRIOR = 2e-3
"""Pull of the rod's bend angles toward the arcs' [m/rad]. The rod's polyline reaches a little less far
than the arcs: the pull keeps its angles smooth where the reference touches its fold, for 0.03 mm."""


class RodModel:
    """A limb's rod, its kinematics for evenly bent segments, and the balance of forces along a motion.

    Args:
        limb: the physical parameters.
        nodes: N of the rod.
    """

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        self.limb = limb
        self.rod = Rod.from_limb(limb, nodes)
        self.kinematics = PolylineKinematics(self.rod.rest_lengths, list(self.rod.segments))
        self.rest = self.rod.equilibrium(np.zeros(limb.segment_count))
        self._x = np.arange(nodes) * 4
        self._free = self.rod.free

    def configuration(self, reference: Reference) -> BSpline:
        """Return the rod's bend angles (M,) [rad] as a spline of time that follows r̄(t).

        Raises:
            UnreachableError: a point is out of reach of the rod, or beyond the pressure limit.
        """
        time, tip, guess = reference.time, reference.tip, reference.bend_angles
        if self.limb.segment_count == 1:
            # One angle cannot follow two coordinates: the rod bends as the arc does.
            return resting_spline(time, guess)
        angles, distances = solve(self.kinematics, tip, guess, REFERENCE_PRIOR)
        check_reach(self.limb, self.kinematics, time, tip, angles, distances)
        return resting_spline(time, angles)

    def pressures(self, method: str, q: Vector, v: Vector, a: Vector) -> Vector:
        """Return effective pressures (K, M) [Pa] by the method ``paper`` or ``projected``."""
        if method == "paper":
            return self.paper_pressures(q, v, a)
        return self.projected_pressures(q, v, a)

    def simulate(self, pressures: Vector, period: float) -> Vector:
        """Return the tip (K, 2) [m] at the start of each interval, from rest.

        Args:
            pressures: (K, S, M) effective pressures of each integrator step [Pa].
            period: of an interval [s].
        """
        motion = self.rod.simulate(self.rest, pressures, period, substeps=pressures.shape[1])
        tip: Vector = motion.tip[:-1, :2]
        return tip

    def _needed_force(self, angles: Vector, rates: Vector, accelerations: Vector) -> Vector:
        """Return M q̈ + D q̇ − F_int − F_ext (K, 4N−1) that the couples must supply [N]."""
        position, velocity, acceleration = self.kinematics.motion(angles, rates, accelerations)
        size = self.rod.mass_diagonal.size
        force = np.tile(-self.rod.external_force, (len(angles), 1))
        straight = self.rod.straight_state().q
        for k in range(len(angles)):
            q, v, a = straight.copy(), np.zeros(size), np.zeros(size)
            for axis in range(2):
                rows = self._x + axis
                q[rows] = position[k, :, axis]
                v[rows] = velocity[k, :, axis]
                a[rows] = acceleration[k, :, axis]
            force[k] += self.rod.mass_diagonal * a + self.rod.damping_diagonal * v
            force[k] -= self.rod.internal_force(q)
        return force

    def projected_pressures(self, angles: Vector, rates: Vector, accelerations: Vector) -> Vector:
        """Return (K, M) pressures [Pa] from Sᵀ (M q̈ + D q̇ − F_int − F_ext) = Sᵀ B Λ u.

        Args:
            angles, rates, accelerations: (K, M) of evenly bent segments [rad], [rad/s], [rad/s²].
        """
        force = self._needed_force(angles, rates, accelerations)
        tangents = self.kinematics.tangents(angles)
        planar = np.stack([force[:, self._x], force[:, self._x + 1]], axis=-1)
        load = np.einsum("kmna,kna->km", tangents, planar)
        # A couple on an edge works on that edge's turning: Sᵀ B Λ is diagonal, gain times edge length.
        lever = [first + 0 for first, _ in self.rod.segments]
        gain = self.rod.input_gain * self.rod.rest_lengths[lever]
        pressures: Vector = load / gain
        return pressures + self._material_damping(rates) / gain

    def paper_pressures(self, angles: Vector, rates: Vector, accelerations: Vector) -> Vector:
        """Return (K, M) pressures [Pa] from (B Λ)† (M q̈ + D q̇ − F_int − F_ext) on the free rows.

        Args:
            angles, rates, accelerations: (K, M) of evenly bent segments [rad], [rad/s], [rad/s²].
        """
        force = self._needed_force(angles, rates, accelerations)
        positions = self.kinematics.nodes(angles)
        lever = [first for first, _ in self.rod.segments]
        gain = self.rod.input_gain * self.rod.rest_lengths[lever]
        pressures = self._material_damping(rates) / gain
        straight = self.rod.straight_state().q
        for k in range(len(force)):
            q = straight.copy()
            q[self._x], q[self._x + 1] = positions[k, :, 0], positions[k, :, 1]
            matrix = self.rod.input_matrix(q)[self._free]
            pressures[k] += np.linalg.lstsq(matrix, force[k, self._free], rcond=None)[0]
        return pressures

    def _material_damping(self, rates: Vector) -> Vector:
        """Return EI τ θ̇ / L (K, M), the moment of the Kelvin-Voigt term [N·m]."""
        moments = [s.bending_stiffness * s.material_damping / s.length for s in self.limb.segments]
        damping: Vector = np.array(moments) * rates
        return damping
