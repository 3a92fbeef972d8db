"""`simulate`: what a limb does under commands or under pressures in its chambers.

Commands become chamber pressures by `air`, these become effective pressures by `material`, and the
rod or the arcs bend under the effective pressures. Nothing else in the project puts these three
together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb
from der_planner.model import material
from der_planner.model.derivative import Derivative
from der_planner.model.drive import Bend
from der_planner.model.inputs import prepare
from der_planner.model.physics import (
    NODES,
    ArcModel,
    ArcState,
    Model,
    Motion,
    RodModel,
    Shot,
    State,
    build,
    tip_and_bend,
)
from der_planner.rod import Trajectory

__all__ = [
    "NODES",
    "ArcModel",
    "ArcState",
    "Model",
    "Motion",
    "Response",
    "RodModel",
    "Shot",
    "State",
    "build",
    "simulate",
    "tip_and_bend",
]
Array = NDArray[np.float64]


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
    """
    physics = build(limb, model, nodes) if isinstance(limb, Limb) else limb
    case = prepare(physics, time, commands, pressures, bend, start, before, memory, steps)
    motion = physics.run(case.begin, case.chain.effective, case.period, linearise=linearise)
    return Response(
        case.boundaries,
        case.chain.differential,
        case.chain.effective,
        motion.bend_angles,
        motion.tip,
        motion.final,
        case.memory,
        motion.trajectory,
        case.derivative(physics, motion) if linearise else None,
    )
