"""Many limbs, or one limb under many inputs, in one call on all cores of the machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb
from der_planner.model import material
from der_planner.model.bending import angles_of_outputs
from der_planner.model.derivative import Derivative
from der_planner.model.drive import Bend
from der_planner.model.inputs import Case, prepare
from der_planner.model.physics import NODES, ArcModel, Motion, RodModel, State, build, tip_and_bend
from der_planner.rod import RodState
from der_planner.rod.many import in_threads, naming, one_each
from der_planner.rod.many import simulate_many as simulate_rods

Array = NDArray[np.float64]
Physics = RodModel | ArcModel


@dataclass(frozen=True)
class ManyResponses:
    """What R limbs do in K intervals of equal length, S integrator steps each.

    Attributes:
        time: (K+1,) boundaries of the intervals [s].
        differential_pressure: (R, K, S, M) in the chambers, amid each integrator step [Pa].
        effective_pressure: (R, K, S, M) what each model bends under [Pa].
        bend_angles: (R, K+1, M) [rad].
        tip: (R, K+1, 2) [m].
        final: (R,) states at the end.
        memory: (R,) of friction and creep at the last instant at which they were computed.
        derivative: (R,) by the commands or pressures that were given; empty if not asked for.
    """

    time: Array
    differential_pressure: Array
    effective_pressure: Array
    bend_angles: Array
    tip: Array
    final: tuple[State, ...]
    memory: tuple[material.Memory, ...]
    derivative: tuple[Derivative, ...] = ()


def simulate_many(
    limbs: Limb | RodModel | ArcModel | Sequence[Limb] | Sequence[RodModel] | Sequence[ArcModel],
    time: ArrayLike,
    *,
    commands: ArrayLike | None = None,
    pressures: ArrayLike | None = None,
    model: str = "der",
    bend: Bend | Sequence[Bend] | None = None,
    start: State | Sequence[State] | None = None,
    before: ArrayLike | None = None,
    memory: material.Memory | Sequence[material.Memory] | None = None,
    steps: int | None = None,
    nodes: int = NODES,
    linearise: bool = False,
    threads: int | None = None,
) -> ManyResponses:
    """Simulate R limbs in one call on all cores; run r is that of `simulate` for limb and input r.

    Arguments are those of `simulate`, and each may be one for all runs or a list of R. With
    ``linearise`` each run keeps its derivative: about 10 kB a step of a rod with 21 nodes.

    Args:
        limbs: one limb or model, or a list of R with equal numbers of segments.
        time: (K,) regular instants [s], the same for all.
        commands: (R, K, M), or (K, M) for all [Pa].
        pressures: (R, K, M), or (K, M) for all [Pa]. Give these or ``commands``.
        model: "der" or "pcc", unless models are given.
        bend: one, or a list.
        start: one, or a list.
        before: (M,) or (R, M) [Pa].
        memory: one, or a list.
        steps: S.
        nodes: of the rods, unless models are given.
        linearise: also give the derivatives (of rods).
        threads: at most so many; default one for each core.

    Raises:
        ValueError: as `simulate`, or numbers of runs that do not fit together.
        ConvergenceError: a rod could not be simulated; names the run.
    """
    series = _series(limbs, commands, pressures)
    runs = len(series)
    models = _models(one_each(limbs, runs, "limbs"), model, nodes)
    bends, starts = one_each(bend, runs, "bend"), one_each(start, runs, "start")
    memories = one_each(memory, runs, "memory")
    earlier = _before(before, (runs, series[0].shape[-1]))

    def case_of(run: int) -> Case:
        given = (None, series[run]) if commands is None else (series[run], None)
        begin = (bends[run], starts[run], earlier[run], memories[run])
        with naming(run):
            return prepare(models[run], time, given[0], given[1], *begin, steps)

    cases = in_threads(case_of, runs, threads)
    tip, angles, final, derivative = _run_many(models, cases, linearise, threads)
    differential = np.stack([case.chain.differential for case in cases])
    effective = np.stack([case.chain.effective for case in cases])
    last, time = tuple(case.memory for case in cases), cases[0].boundaries
    return ManyResponses(time, differential, effective, angles, tip, final, last, derivative)


def _series(limbs: object, commands: ArrayLike | None, pressures: ArrayLike | None) -> list[Array]:
    """Return the commands or pressures (K, M) [Pa] of each run.

    Raises:
        ValueError: none or both are given, or their number is not that of the limbs.
    """
    if (commands is None) == (pressures is None):
        raise ValueError("give either commands or pressures")
    given = np.asarray(pressures if commands is None else commands, dtype=float)
    listed = len(limbs) if isinstance(limbs, (list, tuple)) else None
    runs = listed if listed is not None else len(given) if given.ndim == 3 else 0
    if runs == 0 or given.ndim not in (2, 3) or (given.ndim == 3 and len(given) != runs):
        raise ValueError(
            "expected commands or pressures (R, K, M), or (K, M) with a list of R limbs, got "
            f"{given.shape} and {'one' if listed is None else listed} limb(s)"
        )
    return list(given) if given.ndim == 3 else [given] * runs


def _before(given: ArrayLike | None, shape: tuple[int, int]) -> list[Array | None]:
    """Return the commands before the first ones of each run, (M,) [Pa], None for vented."""
    if given is None:
        return [None] * shape[0]
    before = np.asarray(given, dtype=float)
    if before.shape not in (shape[1:], shape):
        raise ValueError(f"before must have shape {shape[1:]} or {shape}, got {before.shape}")
    return list(np.broadcast_to(before, shape))


def _models(
    limbs: Sequence[Limb | RodModel | ArcModel], model: str, nodes: int
) -> list[RodModel | ArcModel]:
    """Return the model of each limb; a limb that comes twice has one model, computed once."""
    distinct: dict[int, RodModel | ArcModel] = {}
    for limb in limbs:
        if id(limb) not in distinct:
            built = build(limb, model, nodes) if isinstance(limb, Limb) else limb
            distinct[id(limb)] = built
            _ = built.rest  # kept by the model, so that threads only read it
    models = [distinct[id(limb)] for limb in limbs]
    if len({each.limb.segment_count for each in models}) > 1 or len(set(map(type, models))) > 1:
        raise ValueError("limbs must all have as many segments, and be all rods or all arcs")
    return models


def _run_many(
    models: Sequence[RodModel | ArcModel],
    cases: Sequence[Case],
    linearise: bool,
    threads: int | None,
) -> tuple[Array, Array, tuple[State, ...], tuple[Derivative, ...]]:
    """Return tips (R, K+1, 2), bend angles (R, K+1, M), states at the end and derivatives."""
    rods = [each.rod for each in models if isinstance(each, RodModel)]
    begins = [case.begin for case in cases if isinstance(case.begin, RodState)]
    if rods and len(begins) == len(rods) and not linearise:
        found = simulate_rods(
            rods,
            begins,
            np.stack([case.chain.effective for case in cases]),
            cases[0].period,
            substeps=cases[0].chain.effective.shape[1],
            outputs=tip_and_bend(rods[0]),
            threads=threads,
        )
        return (
            found.outputs[:, :, :2], angles_of_outputs(found.outputs[:, :, 2:]), found.final, (),
        )  # fmt: skip

    def alone(run: int) -> Motion:
        case = cases[run]
        with naming(run):
            return models[run].run(
                case.begin, case.chain.effective, case.period, linearise=linearise
            )

    motions = in_threads(alone, len(models), threads)
    derivatives = [
        case.derivative(each, motion)
        for each, motion, case in zip(models, motions, cases, strict=True)
    ]
    return (
        np.stack([motion.tip for motion in motions]),
        np.stack([motion.bend_angles for motion in motions]),
        tuple(motion.final for motion in motions),
        tuple(each for each in derivatives if each is not None) if linearise else (),
    )
