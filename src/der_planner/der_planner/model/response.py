"""`simulate`: what a limb does under commands or under pressures in its chambers.

Commands become chamber pressures by `air`, these become effective pressures by `material`, and the
rod or the arcs bend under the effective pressures. Nothing else in the project puts these three
together.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb
from der_planner.model import air, material
from der_planner.model.bending import (
    ArcKinematics,
    Kinematics,
    PolylineKinematics,
    bend_angles,
    bend_outputs,
)
from der_planner.model.derivative import (
    ArcSlopes,
    Chain,
    Derivative,
    OfInstants,
    OfWindow,
    RodSlopes,
)
from der_planner.model.drive import STEPS, Bend, Drive
from der_planner.model.series import step_middles
from der_planner.pcc import Linearisation, Pcc
from der_planner.rod import Rod, RodState, Trajectory

Array = NDArray[np.float64]
NODES = 21
"""Of the rod, where nothing else is asked for."""
_ARC_STEP = 0.01
"""Integrator step of the arcs under measured pressures [s]."""


# The two models --------------------------------------------------------------------------------


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
        """The vented limb at rest under its loads."""
        return self.resting(np.zeros(self.limb.segment_count))

    def resting(self, effective: Array) -> ArcState:
        """Return the arcs at rest under effective pressures (M,) [Pa] and gravity."""
        angles = self.pcc.equilibrium(effective)
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


# All together ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Response:
    """What a limb does in K intervals of equal length, S integrator steps each.

    Attributes:
        time: (K+1,) boundaries of the intervals [s].
        differential_pressure: (K, S, M) in the chambers, amid each integrator step [Pa].
        effective_pressure: (K, S, M) what the model bends under in each step [Pa].
        bend_angles: (K+1, M) [rad].
        tip: (K+1, 2) [m].
        final: state at the end.
        memory: of friction and creep at the last instant at which they were computed.
        trajectory: of the rod's nodes; None for the arcs.
        derivative: by the commands or pressures that were given, if it was asked for.
    """

    time: Array
    differential_pressure: Array
    effective_pressure: Array
    bend_angles: Array
    tip: Array
    final: State
    memory: material.Memory
    trajectory: Trajectory | None = None
    derivative: Derivative | None = None


def simulate(
    limb: Limb | RodModel | ArcModel,
    time: ArrayLike,
    *,
    commands: ArrayLike | None = None,
    pressures: ArrayLike | None = None,
    model: str = "der",
    bend: Bend | None = None,
    start: State | None = None,
    before: ArrayLike | None = None,
    memory: material.Memory | None = None,
    steps: int | None = None,
    nodes: int = NODES,
    linearise: bool = False,
) -> Response:
    """Simulate a limb under commands, or under the pressures that its chambers hold.

    Args:
        limb: calibrated limb, or a model of one that was built before.
        time: (K,) regular instants [s].
        commands: (K, M) differential pressures that are commanded, each held for a period [Pa]: K
            intervals.
        pressures: (K, M) differential pressures in the chambers at the instants [Pa]: K − 1
            intervals, with the mean of both ends in each. Give these or ``commands``.
        model: "der" or "pcc", unless ``limb`` is a model.
        bend: bend angles of the motion along which friction and creep act; None: along the bend at
            rest under the pressures (`material.resting_bend`).
        start: state at ``time[0]``; None: at rest, vented, or under the first ``pressures``.
        before: (M,) command before the first one, which the chambers had reached [Pa]; None:
            vented.
        memory: of friction and creep at ``time[0]``; None: a limb that has rested.
        steps: S, integrator steps an interval; default 5 for commands, for pressures 1 (rod) or one
            of 10 ms (arcs).
        nodes: of the rod, unless ``limb`` is a model.
        linearise: also give the derivative.

    Raises:
        ValueError: neither or both of commands and pressures, or shapes that do not fit.
        ConvergenceError: the rod could not be simulated.
        NoRestError: the arcs do not come to rest under their load.
    """
    physics = build(limb, model, nodes) if isinstance(limb, Limb) else limb
    times = np.asarray(time, dtype=float)
    given = _given(commands, pressures, times, physics.limb.segment_count)
    period = float(times[1] - times[0])
    at_rest: tuple[RodState, Array] | None = None
    if commands is not None:
        chain, remembered = _from_commands(
            physics.limb, given, period, steps or STEPS, bend, before, memory
        )
        boundaries = np.append(times, times[-1] + period)
        begin: State = physics.rest if start is None else start
    else:
        count = steps or (1 if isinstance(physics, RodModel) else max(1, round(period / _ARC_STEP)))
        chain, remembered, first = _from_pressures(physics.limb, times, given, count, bend, memory)
        boundaries = times
        begin = physics.resting(first) if start is None else start
        if start is None and isinstance(begin, RodState):
            at_rest = begin, first
    motion = physics.run(begin, chain.effective, period, linearise=linearise)
    derivative = None
    if linearise and isinstance(physics, RodModel) and motion.trajectory is not None:
        derivative = Derivative(RodSlopes(physics.rod, motion.trajectory, at_rest), chain)
    if linearise and isinstance(physics, ArcModel) and motion.linearisation is not None:
        resting = start is None and pressures is not None
        slopes = ArcSlopes(physics.pcc, motion.bend_angles, motion.linearisation, at_rest=resting)
        derivative = Derivative(slopes, chain)
    return Response(
        boundaries,
        chain.differential,
        chain.effective,
        motion.bend_angles,
        motion.tip,
        motion.final,
        remembered,
        motion.trajectory,
        derivative,
    )


def _given(
    commands: ArrayLike | None, pressures: ArrayLike | None, time: Array, inputs: int
) -> Array:
    if (commands is None) == (pressures is None):
        raise ValueError("give either commands or pressures")
    given = np.asarray(pressures if commands is None else commands, dtype=float)
    if time.ndim != 1 or time.size < 2 or given.shape != (time.size, inputs):
        raise ValueError(
            f"expected time (K,) of two instants or more and commands or pressures (K, {inputs}), "
            f"got {time.shape} and {given.shape}"
        )
    if not np.allclose(np.diff(time), time[1] - time[0], rtol=1e-6, atol=1e-9):
        raise ValueError("the instants must be evenly spaced: resample the series first")
    return given


def _from_commands(
    limb: Limb,
    command: Array,
    period: float,
    steps: int,
    bend: Bend | None,
    before: ArrayLike | None,
    memory: material.Memory | None,
) -> tuple[Chain, material.Memory]:
    inputs = limb.segment_count
    vented = np.zeros(inputs) if before is None else np.array(before, dtype=float)
    if bend is not None:
        drive = Drive(limb, bend, len(command), steps, vented, memory, period)
        window = drive.window(command)
        return OfWindow(window.effective, window.differential, window), drive.memory()
    chambers = air.follow_commands(limb.pneumatics, command, period, steps, vented)
    middle = step_middles(len(command), steps, period)
    flat = np.ascontiguousarray(chambers.differential.reshape(-1, inputs))
    effective, history = _slow(limb, middle, flat, memory)
    chain = OfInstants(
        effective.reshape(chambers.differential.shape),
        chambers.differential,
        lambda: material.SlowSlopes(limb, middle, flat, effective, memory),
        chambers,
    )
    return chain, history.at(-1)


def _from_pressures(
    limb: Limb,
    time: Array,
    pressure: Array,
    steps: int,
    bend: Bend | None,
    memory: material.Memory | None,
) -> tuple[Chain, material.Memory, Array]:
    """Return also the effective pressures (M,) at the first instant."""
    if bend is None:
        effective, history = _slow(limb, time, pressure, memory)
    else:
        history = material.remember(limb, time, bend(time), memory)
        effective = material.without_memory(limb, pressure, material.taken_by(limb, history))

    def slopes() -> material.SlowSlopes | material.Slopes:
        if bend is None:
            return material.SlowSlopes(limb, time, pressure, effective, memory)
        return material.slopes(limb, pressure, effective)

    held = [pressures_between(table, steps) for table in (effective, pressure)]
    return OfInstants(held[0], held[1], slopes), history.at(-1), effective[0]


def _slow(
    limb: Limb, time: Array, pressure: Array, memory: material.Memory | None
) -> tuple[Array, material.MemoryHistory]:
    """Return effective pressures (K, M) [Pa] along the bend at rest, and what is remembered."""
    bend = material.resting_bend(limb, time, pressure, memory)
    history = material.remember(limb, time, bend, memory)
    return material.without_memory(limb, pressure, material.taken_by(limb, history)), history


def pressures_between(pressure: Array, steps: int) -> Array:
    """Return (K − 1, S, M) means of the pressures (K, M) at both ends of each interval."""
    middle = 0.5 * (pressure[1:] + pressure[:-1])
    return np.repeat(middle[:, None, :], steps, axis=1)
