"""From commands, or from pressures in the chambers, to what a model is simulated with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb
from der_planner.model import air, material
from der_planner.model.derivative import (
    ArcSlopes,
    Chain,
    Derivative,
    OfInstants,
    OfWindow,
    RodSlopes,
)
from der_planner.model.drive import STEPS, Bend, Drive
from der_planner.model.physics import ArcModel, Motion, RodModel, State
from der_planner.model.series import step_middles
from der_planner.rod import RodState

Array = NDArray[np.float64]
_ARC_STEP = 0.01
"""Integrator step of the arcs under measured pressures [s]."""


@dataclass(frozen=True)
class Case:
    """What a model is to be run with; names as of `response.simulate`.

    Attributes:
        rests_under: (M,) the first effective pressures [Pa], where the start rests under them.
    """

    boundaries: Array
    period: float
    chain: Chain
    begin: State
    memory: material.Memory
    rests_under: Array | None = None

    def derivative(self, physics: RodModel | ArcModel, motion: Motion) -> Derivative | None:
        """Return the derivative of a motion; None if it was not linearised."""
        if isinstance(physics, ArcModel):
            if motion.linearisation is None:
                return None
            rests = self.rests_under is not None
            arcs = ArcSlopes(physics.pcc, motion.bend_angles, motion.linearisation, at_rest=rests)
            return Derivative(arcs, self.chain)
        if motion.trajectory is None or motion.trajectory.linearisation is None:
            return None
        at_rest = None
        if self.rests_under is not None and isinstance(self.begin, RodState):
            at_rest = self.begin, self.rests_under
        return Derivative(RodSlopes(physics.rod, motion.trajectory, at_rest), self.chain)


def prepare(
    physics: RodModel | ArcModel,
    time: ArrayLike,
    commands: ArrayLike | None,
    pressures: ArrayLike | None,
    bend: Bend | None,
    start: State | None,
    before: ArrayLike | None,
    memory: material.Memory | None,
    steps: int | None,
) -> Case:
    """Follow commands or pressures to the effective ones; arguments and errors of `simulate`."""
    times = np.asarray(time, dtype=float)
    given = _check(commands, pressures, times, physics.limb.segment_count)
    period = float(times[1] - times[0])
    if commands is not None:
        chain, remembered = _from_commands(
            physics.limb, given, period, steps or STEPS, bend, before, memory
        )
        boundaries = np.append(times, times[-1] + period)
        begin: State = physics.rest if start is None else start
        return Case(boundaries, period, chain, begin, remembered)
    count = steps or (1 if isinstance(physics, RodModel) else max(1, round(period / _ARC_STEP)))
    chain, remembered, first = _from_pressures(physics.limb, times, given, count, bend, memory)
    begin = physics.resting(first) if start is None else start
    return Case(times, period, chain, begin, remembered, first if start is None else None)


def _check(
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
    """Return effective pressures (K, M) [Pa] along the bend at rest, and the memory left."""
    bend = material.resting_bend(limb, time, pressure, memory)
    history = material.remember(limb, time, bend, memory)
    return material.without_memory(limb, pressure, material.taken_by(limb, history)), history


def pressures_between(pressure: Array, steps: int) -> Array:
    """Return (K − 1, S, M) means of the pressures (K, M) at both ends of each interval."""
    middle = 0.5 * (pressure[1:] + pressure[:-1])
    return np.repeat(middle[:, None, :], steps, axis=1)
