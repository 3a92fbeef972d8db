"""One face for both models: configurations for a reference, effective pressures, and simulation."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from der_planner.limb import Limb
from der_planner.pcc import Pcc
from der_planner.planning.errors import PlanningError
from der_planner.planning.inverse import check_reach
from der_planner.planning.kinematics import ArcKinematics, Kinematics
from der_planner.planning.motions import Reference, sample_spline
from der_planner.planning.rod_model import RodModel

Vector = NDArray[np.float64]

METHODS = {"der": ("paper", "projected", "optimal"), "pcc": ("paper",)}
"""The methods of each model."""


class PlanningModel(Protocol):
    """What a planner needs of a model."""

    limb: Limb

    @property
    def kinematics(self) -> Kinematics:
        """Forward kinematics."""

    def configuration(self, reference: Reference) -> BSpline:
        """Return the model's bend angles (M,) [rad] along the reference, as a spline of time."""

    def pressures(self, method: str, spline: BSpline, time: Vector) -> Vector:
        """Return effective pressures (K, M) [Pa] at evenly spaced instants (K,) of a motion."""

    def simulate(self, pressures: Vector, period: float, spline: BSpline | None = None) -> Vector:
        """Return the tip (K, 2) [m] at the start of each interval, under (K, S, M) pressures [Pa].

        From rest, or from the beginning of a motion ``spline`` of bend angles.
        """


class ArcModel:
    """The PCC baseline as a planning model."""

    def __init__(self, limb: Limb) -> None:
        self.limb = limb
        self.model = Pcc(limb)
        self.kinematics = ArcKinematics(limb)

    def configuration(self, reference: Reference) -> BSpline:
        """Return q̄(t) itself: the reference is made of arcs."""
        misses = np.zeros(len(reference.time))
        check_reach(
            self.limb, self.kinematics, reference.time, reference.tip, reference.bend_angles, misses
        )
        return reference.spline

    def pressures(self, method: str, spline: BSpline, time: Vector) -> Vector:
        """Return u = Λ† (M q̈ + (C + D) q̇ + K q) at instants (K,) [s]."""
        if method != "paper":
            raise PlanningError(f"the PCC model has no method '{method}': choose paper")
        return self.model.pressures(*sample_spline(spline, time))

    def simulate(self, pressures: Vector, period: float, spline: BSpline | None = None) -> Vector:
        """Return the tip (K, 2) [m] at the start of each interval."""
        state = (None, None) if spline is None else (spline(0.0), spline(0.0, 1))
        angles, _ = self.model.simulate(pressures, period / pressures.shape[1], *state)
        return self.model.tip(angles[:-1])


def build(limb: Limb, model: str, nodes: int) -> PlanningModel:
    """Return the planning model of a limb.

    Raises:
        PlanningError: unknown model.
    """
    if model not in METHODS:
        raise PlanningError(f"model '{model}' is unknown: choose {' or '.join(METHODS)}")
    seen = limb.for_model(model)
    return RodModel(seen, nodes) if model == "der" else ArcModel(seen)
