"""The rod as planners use it: its configurations for a reference, and its balance of forces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.model.balance import Balance
from der_planner.model.response import NODES, RodModel
from der_planner.planning.inverse import NEAREST_TOLERANCE, TOLERANCE, check_reach, solve
from der_planner.planning.motions import Reference, resting_spline, sample_spline

Array = NDArray[np.float64]

REFERENCE_PRIOR = 2e-3
"""Pull of the rod's bend angles toward the arcs' [m/rad]. The rod's polyline reaches a little less
far than the arcs: the pull keeps its angles smooth where the reference touches its fold, and costs
0.03 mm."""

POSITION_GAIN = 20.0
"""K_p of the method ``paper`` [1/s²]."""
VELOCITY_GAIN = 8.0
"""K_d of the method ``paper`` [1/s]: with K_p a damped return at 0.7 Hz."""


class PlanningRod(RodModel):
    """A limb's rod with the configurations and pressures that a reference needs.

    Args:
        limb: the physical parameters.
        nodes: N of the rod.
    """

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        super().__init__(limb, nodes)
        self.balance = Balance(self.rod, self.kinematics)

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
        tolerance = TOLERANCE if reference.deviation is None else NEAREST_TOLERANCE
        check_reach(self.limb, self.kinematics, time, tip, angles, distances, tolerance)
        return resting_spline(time, angles, reference.start)

    def pressures(self, method: str, spline: BSpline, time: Array) -> Array:
        """Return effective pressures (K, M) [Pa] by ``paper`` or ``projected``.

        Args:
            method: of the two.
            spline: bend angles of evenly bent segments [rad].
            time: (K,) evenly spaced instants [s].
        """
        q, v, a = sample_spline(spline, time)
        if method == "paper":
            return self._paper_beside_the_model(q, v, a, float(time[1] - time[0]))
        return self.balance.projected(q, v, a)

    def _paper_beside_the_model(self, q: Array, v: Array, a: Array, step: float) -> Array:
        """Return (B Λ)† (M (q̄̈ + K_d ė + K_p e) + D q̄̇ − F_int − F_ext), e from the simulated rod.

        The rod is simulated beside the equation, under the pressures that it has given so far; its
        distance e from the reference enters through the gains.
        """
        pressures = self.balance.paper(q, v, a)
        inverse = self.balance.inverse_inputs(q)
        position, velocity, _ = (part[:, 1:] for part in self.kinematics.motion(q, v, a))
        mass = self.rod.mesh.node_mass[1:, None]
        state = self.rest if not v[0].any() else self.state(q[0], v[0])
        for k in range(len(q)):
            gap = position[k] - np.column_stack([state.q[4::4], state.q[5::4]])
            rate = velocity[k] - np.column_stack([state.v[4::4], state.v[5::4]])
            correction = mass * (VELOCITY_GAIN * rate + POSITION_GAIN * gap)
            pressures[k] += inverse[k] @ correction.ravel()
            state = self.rod.simulate(state, pressures[k, None], step, substeps=2).final
        return pressures
