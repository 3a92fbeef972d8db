"""Rod and arcs as planners use them: configurations and effective pressures for a reference."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.model.response import ArcModel
from der_planner.planning.errors import PlanningError
from der_planner.planning.inverse import check_reach
from der_planner.planning.motions import Reference, sample_spline
from der_planner.planning.rod_model import PlanningRod

Array = NDArray[np.float64]

METHODS = {"der": ("paper", "projected", "optimal"), "pcc": ("paper",)}
"""The methods of each model."""


class PlanningArcs(ArcModel):
    """The PCC baseline as a planning model."""

    def configuration(self, reference: Reference) -> BSpline:
        """Return q̄(t) itself: the reference is made of arcs."""
        misses = np.zeros(len(reference.time))
        check_reach(
            self.limb, self.kinematics, reference.time, reference.tip, reference.bend_angles, misses
        )
        return reference.spline

    def pressures(self, method: str, spline: BSpline, time: Array) -> Array:
        """Return u = Λ† (M q̈ + (C + D) q̇ + K q) at instants (K,) [s]."""
        if method != "paper":
            raise PlanningError(f"the PCC model has no method '{method}': choose paper")
        return self.pcc.pressures(*sample_spline(spline, time))


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
