"""Rod and arcs as planners use them: configurations and effective pressures for a reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.model import ArcModel, ArcState
from der_planner.model.material import Material
from der_planner.planning.errors import BucklingError, PlanningError
from der_planner.planning.inverse import check_reach, solve, static_pressure
from der_planner.planning.loads.overload import check_load, check_stays
from der_planner.planning.loads.posed import REFERENCE_PRIOR
from der_planner.planning.motions import Reference
from der_planner.planning.rod_model import PlanningRod
from der_planner.planning.ways import Start, resting_spline, sample_spline

Array = NDArray[np.float64]

METHODS = {"der": ("paper", "projected", "optimal"), "pcc": ("paper", "projected", "optimal")}
"""The methods of each model. Arcs have one unknown a pressure: their two balances are the same."""
_FALLEN = 1.0
"""Arcs that rest this far from the rod have buckled [rad]."""


class PlanningArcs(ArcModel):
    """The PCC baseline as a planning model."""

    def configuration(self, reference: Reference) -> BSpline:
        """Return q̄(t) itself: the reference is made of arcs.

        Under gravity the arcs rest elsewhere than the rod whose rest the reference begins with:
        there they follow r̄(t) from their own rest.

        Raises:
            UnreachableError: a point is beyond the pressure limit.
            BucklingError: the arcs do not rest under their load.
            OverloadError: gravity's load takes more than the pressure limit.
        """
        time, tip, angles = reference.time, reference.tip, reference.bend_angles
        if not self.is_loaded:
            check_reach(self.limb, self.kinematics, time, tip, angles, np.zeros(len(time)))
            return reference.spline
        home = self.rest.angles
        if np.abs(home - reference.rest).max() > _FALLEN:
            raise BucklingError(
                "the arcs fall over under their load where the rod stands: make the limb lighter "
                "or stiffer, or mount it otherwise"
            )
        near = angles + (home - reference.rest)
        # Points that the rod reaches and the arcs miss are no refusal: the plan's error shows them.
        own = solve(self.kinematics, tip, near, REFERENCE_PRIOR)[0]

        def needed(limb: Limb) -> Array:
            return Material(limb).differential_pressure(time, static_pressure(limb, own), own)

        stiffness = np.array([self.smallest_stiffness(pose) for pose in own])
        check_stays(stiffness, time, tip, "arcs")
        check_load(self.limb, time, tip, needed(self.limb), needed)
        return resting_spline(time, own, reference.start)

    def begin(self, spline: BSpline, start: Start | None) -> ArcState:
        """Return the state in which a motion begins: at rest, or where another one is left."""
        return self.rest if start is None else self.state(spline(0.0), spline(0.0, 1))

    def pressures(self, method: str, spline: BSpline, time: Array, _: Start | None = None) -> Array:
        """Return u = Λ† (M q̈ + (C + D) q̇ + K q − Q_gravity) at instants (K,) [s].

        ``paper`` and ``projected`` are the same.
        """
        if method not in METHODS["pcc"]:
            raise PlanningError(f"the PCC model has no balance '{method}'")
        return self.inverse_dynamics(*sample_spline(spline, time))


def build(limb: Limb, model: str, nodes: int) -> PlanningRod | PlanningArcs:
    """Return the planning model of a limb.

    Raises:
        PlanningError: unknown model.
    """
    if model not in METHODS:
        raise PlanningError(f"model '{model}' is unknown: choose {' or '.join(METHODS)}")
    seen = limb.for_model(model)
    return PlanningRod(seen, nodes) if model == "der" else PlanningArcs(seen)


PlanningModel = PlanningRod | PlanningArcs
