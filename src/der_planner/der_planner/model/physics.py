"""The two models of a limb, which bend under effective pressures: the rod and the arcs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb
from der_planner.model.bending import (
    ArcKinematics,
    Kinematics,
    PolylineKinematics,
    bend_angles,
    bend_outputs,
)
from der_planner.pcc import Pcc
from der_planner.rod import Rod, RodState, Trajectory

Array = NDArray[np.float64]
NODES = 21
"""Of the rod, where nothing else is asked for."""


@dataclass(frozen=True)
class Motion:
    """How a model moved in K intervals.

    Attributes:
        bend_angles: (K+1, M) at the beginning of each interval and at the end [rad].
        tip: (K+1, 2) [m].
        final: state at the end, from which the same model can go on.
        trajectory: of the rod, with all nodes; None for the arcs.
    """

    bend_angles: Array
    tip: Array
    final: State
    trajectory: Trajectory | None = None


@dataclass(frozen=True)
class ArcState:
    """Bend angles [rad] and rates [rad/s] of the arcs, each (M,)."""

    angles: Array
    rates: Array


State = RodState | ArcState


class Model(Protocol):
    """A limb that bends under effective pressures."""

    limb: Limb

    @property
    def kinematics(self) -> Kinematics:
        """Of evenly bent segments."""

    def state(self, angles: ArrayLike, rates: ArrayLike) -> State:
        """Return the limb evenly bent, at bend angles and rates (M,) [rad], [rad/s]."""

    def resting(self, effective: Array) -> State:
        """Return the limb at rest under effective pressures (M,) [Pa]."""

    def run(
        self, start: State, effective: Array, period: float, *, linearise: bool = False
    ) -> Motion:
        """Simulate K intervals of ``period`` [s] under effective pressures (K, S, M) [Pa]."""


class RodModel:
    """A limb's discrete elastic rod.

    Args:
        limb: the physical parameters.
        nodes: N of the rod.
    """

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        self.limb = limb
        self.rod = Rod.from_limb(limb, nodes)
        self.kinematics = PolylineKinematics.of_rod(self.rod)

    @cached_property
    def rest(self) -> RodState:
        """The vented limb at rest."""
        return self.rod.equilibrium(np.zeros(self.limb.segment_count))

    def resting(self, effective: Array) -> RodState:
        """Return the rod at rest under effective pressures (M,) [Pa]."""
        return self.rod.equilibrium(effective)

    def state(self, angles: ArrayLike, rates: ArrayLike) -> RodState:
        """Return the rod evenly bent, at bend angles and rates (M,) [rad], [rad/s]."""
        position, velocity, _ = self.kinematics.motion(angles, rates, np.zeros(np.shape(rates)))
        q = self.rod.straight_state().q
        v = np.zeros_like(q)
        for axis in range(2):
            q[axis::4], v[axis::4] = position[:, axis], velocity[:, axis]
        return self.rod.state(q, v, like=self.rest)

    def run(
        self, start: State, effective: Array, period: float, *, linearise: bool = False
    ) -> Motion:
        """Simulate the rod; ``linearise`` keeps the derivatives of tip and bend angles."""
        trajectory = self.trajectory(
            start, effective, period, outputs=tip_and_bend(self.rod) if linearise else None
        )
        return Motion(
            bend_angles(self.rod, trajectory.q), trajectory.tip[:, :2], trajectory.final, trajectory
        )

    def trajectory(
        self, start: State, effective: Array, period: float, outputs: list[int] | None = None
    ) -> Trajectory:
        """Return the motion of the rod alone, linearised for ``outputs`` (indices into q)."""
        if not isinstance(start, RodState):
            raise TypeError("the rod starts from a state of the rod, got one of the arcs")
        return self.rod.simulate(
            start,
            effective,
            period,
            substeps=effective.shape[1],
            linearise=outputs is not None,
            outputs=outputs,
        )


class ArcModel:
    """The piecewise-constant-curvature baseline."""

    def __init__(self, limb: Limb) -> None:
        self.limb = limb
        self.pcc = Pcc(limb)
        self.kinematics = ArcKinematics(limb)

    @property
    def rest(self) -> ArcState:
        """The vented limb at rest."""
        return self.resting(np.zeros(self.limb.segment_count))

    def resting(self, effective: Array) -> ArcState:
        """Return the arcs at rest under effective pressures (M,) [Pa] and their weight."""
        angles = self.pcc.resting(effective)
        return ArcState(angles, np.zeros_like(angles))

    def state(self, angles: ArrayLike, rates: ArrayLike) -> ArcState:
        """Return the arcs at bend angles and rates (M,) [rad], [rad/s]."""
        return ArcState(np.asarray(angles, dtype=float), np.asarray(rates, dtype=float))

    def run(
        self, start: State, effective: Array, period: float, *, linearise: bool = False
    ) -> Motion:
        """Simulate the arcs.

        Raises:
            ValueError: a derivative is asked for, which the arcs do not have.
        """
        if linearise:
            raise ValueError("the arcs have no exact derivative: ask for model='der'")
        if not isinstance(start, ArcState):
            raise TypeError("the arcs start from a state of the arcs, got one of the rod")
        step = period / effective.shape[1]
        angles, rates = self.pcc.simulate(effective, step, start.angles, start.rates)
        return Motion(angles, self.pcc.tip(angles), ArcState(angles[-1], rates[-1]))


def tip_and_bend(rod: Rod) -> list[int]:
    """Return the indices into q of the tip's x and y and of what the bend angles depend on."""
    tip = 4 * (rod.nodes - 1)
    return [tip, tip + 1, *bend_outputs(rod)]


def build(limb: Limb, model: str, nodes: int = NODES) -> RodModel | ArcModel:
    """Return the model "der" or "pcc" of a limb.

    Raises:
        LimbError: another model is asked for.
    """
    seen = limb.for_model(model)
    return RodModel(seen, nodes) if model == "der" else ArcModel(seen)
