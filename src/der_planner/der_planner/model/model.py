"""`Model`: one limb that bends under pressure, as a discrete rod or as arcs, built once and passed.

Commands become chamber pressures by its `air`, these become effective pressures by its `material`,
and its body bends under the effective pressures. `der_planner.model.simulation` puts the three
together.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, Literal, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model.air import Air
from der_planner.model.bending import Kinematics
from der_planner.model.material import Material
from der_planner.rod import RodState

AnyModel = TypeVar("AnyModel", bound="Model")
Outputs = Literal["", "tip", "all"]
"""What a linearisation keeps the derivatives of: nothing, the tip, or tip and bend angles."""

NODES = 21
"""Nodes of a rod where nothing else is asked for."""


@dataclass(frozen=True)
class ArcState:
    """Bend angles [rad] and rates [rad/s] of the arcs, each (M,)."""

    angles: Array
    rates: Array


State = RodState | ArcState


class FirstOrder(Protocol):
    """First-order effect of the effective pressures on a simulated motion of K intervals."""

    def tangent(self, effective: Array, start: Array | None = None) -> tuple[Array, Array]:
        """Return the changes of tip (K+1, 2) [m] and bend angles (K+1, M) [rad].

        Args:
            effective: (K, S, M) change of the effective pressures [Pa], or (K, S, M, C) changes,
                which give (K+1, 2, C) and (K+1, M, C).
            start: change of the pose at the beginning, as `Model.rest_slope` times pressures gives
                it; None: none.
        """

    def sensitivity(self, pulse: Array | None = None) -> Array:
        """Return ∂tip/∂input (K+1, 2, K, M) [m/Pa].

        Args:
            pulse: pressure (R, M) in the R steps after the start of an interval when its input is
                raised by one; None: one during its own steps.
        """


@dataclass(frozen=True)
class Rollout:
    """How a model moved in K intervals of S integrator steps.

    Attributes:
        bend_angles: (K+1, M) at the beginning of each interval and at the end [rad].
        tip: (K+1, 2) [m].
        final: state at the end, from which the same model can go on.
        linear: first-order effect of the pressures; None where it was not asked for.
    """

    bend_angles: Array
    tip: Array
    final: State
    linear: FirstOrder | None = None


class Model(ABC):
    """A limb with its air and its material, whose body bends under effective pressures.

    Attributes:
        limb: as the model sees it.
        air: from commands to pressures in the chambers.
        material: from these to effective pressures.
        is_loaded: whether gravity bends it.
    """

    name: ClassVar[str]
    kinematics: Kinematics

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        self.limb, self.nodes = limb, nodes
        self.is_loaded = any(limb.gravity)
        self.air = Air(limb.pneumatics)
        self.material = Material(limb)

    @staticmethod
    def of(limb: Limb, name: str = "der", nodes: int = NODES) -> Model:
        """Return the model "der" (discrete elastic rod) or "pcc" (constant curvature) of a limb.

        Args:
            limb: the physical parameters.
            name: of the model.
            nodes: of the rod.

        Raises:
            LimbError: another model is asked for.
        """
        own = limb.for_model(name)
        return next(kind for kind in Model.__subclasses__() if kind.name == name)(own, nodes)

    def another(self: AnyModel, limb: Limb) -> AnyModel:
        """Return the same model of another limb."""
        return type(self)(limb.for_model(self.name), self.nodes)

    @property
    def inputs(self) -> int:
        """M, the number of segments and of pressures."""
        return self.limb.segment_count

    @cached_property
    def rest(self) -> State:
        """The vented limb at rest."""
        return self.resting(np.zeros(self.inputs))

    @abstractmethod
    def state(self, angles: ArrayLike, rates: ArrayLike) -> State:
        """Return the limb evenly bent, at bend angles and rates (M,) [rad], [rad/s]."""

    @abstractmethod
    def resting(self, effective: Array) -> State:
        """Return the limb at rest under effective pressures (M,) [Pa]."""

    @abstractmethod
    def rest_slope(self, state: Any, effective: Array) -> Array:
        """Return the change of a pose at rest by the effective pressures (M,) that hold it."""

    @abstractmethod
    def run(
        self, start: State, effective: Array, period: float, linearise: Outputs = ""
    ) -> Rollout:
        """Simulate K intervals of ``period`` [s] under effective pressures (K, S, M) [Pa]."""
