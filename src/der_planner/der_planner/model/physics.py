"""The two models of a limb, which bend under effective pressures: the rod and the arcs."""

from __future__ import annotations

from collections.abc import Callable
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
from der_planner.pcc import Linearisation, Pcc
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
        linearisation: of the arcs, if asked for; that of the rod is its trajectory's.
    """

    bend_angles: Array
    tip: Array
    final: State
    trajectory: Trajectory | None = None
    linearisation: Linearisation | None = None


@dataclass(frozen=True)
class Shot:
    """Where the tip went in K intervals, and how the pressures move it.

    Attributes:
        tip: (K+1, 2) at the beginning of each interval and at the end [m].
        final: state at the end.
        sensitivity: returns ∂tip/∂input (K+1, 2, K, M) [m/Pa]; its argument is the pressure (R, M)
            in the R steps after the start of an interval when its input is raised by one, None for
            one during its own steps. Only if asked for.
    """

    tip: Array
    final: State
    sensitivity: Callable[[Array | None], Array] | None = None


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

    def shoot(
        self, start: State, effective: Array, period: float, *, linearise: bool = False
    ) -> Shot:
        """Simulate the same for the tip alone; ``linearise`` gives its sensitivity."""


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

    def shoot(
        self, start: State, effective: Array, period: float, *, linearise: bool = False
    ) -> Shot:
        """Simulate the rod for its tip alone."""
        tip = 4 * (self.rod.nodes - 1)
        motion = self.trajectory(start, effective, period, [tip, tip + 1] if linearise else None)
        linear = motion.linearisation
        return Shot(motion.tip[:, :2], motion.final, None if linear is None else linear.sensitivity)

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

    @cached_property
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
        """Simulate the arcs; ``linearise`` keeps the derivatives of the bend angles."""
        if not isinstance(start, ArcState):
            raise TypeError("the arcs start from a state of the arcs, got one of the rod")
        given = effective, period / effective.shape[1], start.angles, start.rates
        linear = None
        if linearise:
            angles, rates, linear = self.pcc.linearised(*given)
        else:
            angles, rates = self.pcc.simulate(*given)
        final = ArcState(angles[-1], rates[-1])
        return Motion(angles, self.pcc.tip(angles), final, linearisation=linear)

    def shoot(
        self, start: State, effective: Array, period: float, *, linearise: bool = False
    ) -> Shot:
        """Simulate the arcs for their tip alone."""
        motion = self.run(start, effective, period, linearise=linearise)
        linear = motion.linearisation
        if linear is None:
            return Shot(motion.tip, motion.final)
        jacobian = self.pcc.tip_jacobian(motion.bend_angles)

        def sensitivity(pulse: Array | None) -> Array:
            moved: Array = np.einsum("kan,knjm->kajm", jacobian, linear.sensitivity(pulse))
            return moved

        return Shot(motion.tip, motion.final, sensitivity)


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
