"""The rod as planners use it: its configurations for a reference, and its balance of forces."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.model import NODES, RodModel
from der_planner.planning.inverse import (
    NEAREST_TOLERANCE,
    TOLERANCE,
    check_reach,
    solve,
)
from der_planner.planning.loads.posed import REFERENCE_PRIOR, PosedMotion, posed_motion
from der_planner.planning.motions import Reference
from der_planner.planning.ways import Start, resting_spline, sample_spline
from der_planner.rod import RodState

Array = NDArray[np.float64]

POSITION_GAIN = 20.0
"""K_p of the method ``paper`` [1/s²]."""
VELOCITY_GAIN = 8.0
"""K_d of the method ``paper`` [1/s]: with K_p a damped return at 0.7 Hz."""


class PlanningRod(RodModel):
    """A limb's rod with the configurations and pressures that a reference needs.

    Without gravity its configurations are evenly bent, with gravity they are the shapes in which
    pressures hold it.

    Args:
        limb: the physical parameters.
        nodes: N of the rod.
    """

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        super().__init__(limb, nodes)
        self._posed: PosedMotion | None = None

    def configuration(self, reference: Reference) -> BSpline:
        """Return the rod's bend angles (M,) [rad] as a spline of time that follows r̄(t).

        Under gravity the poses are kept for `pressures` and `begin`, which are asked next.

        Raises:
            UnreachableError: a point is out of reach of the rod, or beyond the pressure limit.
            OverloadError: gravity's load takes more than the pressure limit.
            BucklingError: the rod does not stay at a pose on the way.
        """
        if self.is_loaded:
            self._posed = posed_motion(self, reference, self.nodes)
            return self._posed.bend
        time, tip, guess = reference.time, reference.tip, reference.bend_angles
        if self.limb.segment_count == 1:
            # One angle cannot follow two coordinates: the rod bends as the arc does.
            return resting_spline(time, guess, reference.start)
        angles, distances = solve(self.kinematics, tip, guess, REFERENCE_PRIOR)
        tolerance = TOLERANCE if reference.deviation is None else NEAREST_TOLERANCE
        check_reach(self.limb, self.kinematics, time, tip, angles, distances, tolerance)
        return resting_spline(time, angles, reference.start)

    def begin(self, spline: BSpline, start: Start | None) -> RodState:
        """Return the state in which a motion begins: at rest, or where another one is left."""
        if start is None:
            return self.rest
        if self._posed is not None:
            return self._posed.state(0.0)
        return self.state(spline(0.0), spline(0.0, 1))

    def pressures(
        self, method: str, spline: BSpline, time: Array, start: Start | None = None
    ) -> Array:
        """Return effective pressures (K, M) [Pa] by ``paper`` or ``projected``.

        Args:
            method: of the two.
            spline: bend angles of `configuration` [rad].
            time: (K,) evenly spaced instants from 0 on [s].
            start: where the motion begins; None: at rest.
        """
        if self._posed is not None:
            position, velocity, _ = self._posed.sample(time)
            if method != "paper":
                return self._posed.projected(time)
            pressures, inverse = self._posed.paper(time)
            begin = self.begin(spline, start)
            return self._beside_the_model(pressures, inverse, position, velocity, time, begin)
        q, v, a = sample_spline(spline, time)
        if method != "paper":
            return self.balance.projected(q, v, a)
        # (B Λ)† (M q̄̈ + D q̄̇ − F_int − F_ext)
        placed, moving, _ = self.kinematics.motion(q, v, a)
        columns = np.array([4 * node + axis for node in range(self.rod.nodes) for axis in (0, 1)])
        position, velocity = (np.zeros((len(q), 4 * self.rod.nodes - 1)) for _ in range(2))
        position[:, columns] = placed.reshape(len(q), -1)
        velocity[:, columns] = moving.reshape(len(q), -1)
        inverse = self.balance.inverse_inputs(q)
        pressures, begin = self.balance.paper(q, v, a), self.begin(spline, start)
        return self._beside_the_model(pressures, inverse, position, velocity, time, begin)

    def _beside_the_model(
        self,
        pressures: Array,
        inverse: Array,
        position: Array,
        velocity: Array,
        time: Array,
        begin: RodState,
    ) -> Array:
        """Return the pressures (K, M) with (B Λ)† M (K_d ė + K_p e) added.

        The rod is simulated beside the equation, under the pressures that it has given so far; e
        is its distance from the reference.

        Args:
            pressures: (K, M) of the equation without e [Pa].
            inverse: (K, M, F) (B Λ)† on the free rows.
            position: (K, 4N-1) of the reference.
            velocity: (K, 4N-1) of the reference.
            time: (K,) [s].
            begin: state of the rod at the first instant.
        """
        result, free = pressures.copy(), self.rod.free
        mass = self.rod.mass_diagonal[free]
        state, step = begin, float(time[1] - time[0])
        for k in range(len(result)):
            gap, rate = (position[k] - state.q)[free], (velocity[k] - state.v)[free]
            result[k] += inverse[k] @ (mass * (VELOCITY_GAIN * rate + POSITION_GAIN * gap))
            state = self.rod.simulate(state, result[k, None], step, substeps=2).final
        return result
