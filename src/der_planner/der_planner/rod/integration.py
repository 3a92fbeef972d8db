"""Time integration and statics.

Each method is a chain of backward Euler solves; a step that does not converge may be cut. A resting
state is found by Newton's method, with load stepping where that fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod.backend import Backend, ConvergenceError, Piece, RodState
from der_planner.rod.mesh import require
from der_planner.rod.step_kernel import Place, Record, Solver
from der_planner.rod.trajectory import Solved

Method = Literal["sdirk2", "midpoint", "backward_euler"]

_LIMIT = 30  # most Newton iterations of a solve in time
_STATIC_LIMIT = 40  # most Newton iterations of a solve at rest
_SMALLEST_PART = 1.0 / 4096.0  # of a load that is raised in parts
_GAMMA = 1.0 - math.sqrt(0.5)
# fraction of the step that a solve goes over, and e of each solve: see step_kernel
_STAGES = {
    "backward_euler": (1.0, np.array([1.0])),
    "midpoint": (0.5, np.array([2.0])),
    "sdirk2": (_GAMMA, np.array([(1.0 - _GAMMA) / _GAMMA, 1.0])),
}


def solver_of(method: str, dt: float, length: float, lever: float) -> Solver:
    """Return how a method solves steps of dt [s] of a rod of this length [m].

    Raises:
        ValueError: an unknown method.
    """
    require(method in _STAGES, "method", f"one of {sorted(_STAGES)}", method)
    fraction, extrapolate = _STAGES[method]
    return Solver(dt * fraction, extrapolate, 1e-10 * length, lever, _LIMIT)


@dataclass(frozen=True)
class Run:
    """What a simulation returned.

    Attributes:
        q: (K+1, 4N-1). v: likewise.
        final: the last state.
        iterations: Newton iterations of all steps.
        solved: the linearisation, if asked for.
    """

    q: Array
    v: Array
    final: RodState
    iterations: int
    solved: Solved | None


@dataclass
class _Journey:
    """A run under way: its state and its recorded samples."""

    place: Place
    load: Array
    linearise: bool
    method: str
    iterations: int = 0
    records: list[Record] = field(default_factory=list)
    rates: list[Array] = field(default_factory=list)
    extrapolates: list[Array] = field(default_factory=list)
    steps: list[NDArray[np.int64]] = field(default_factory=list)


class Integrator:
    """Runs a backend by one of the methods."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._length = float(backend.mesh.rest.sum())

    def run(
        self, state: RodState, pressures: Array, dt: float, method: str, load: Array,
        linearise: bool = False, halvings: int = 0,
    ) -> Run:  # fmt: skip
        """Run K intervals of S steps of dt under pressures (K, S, M) and load (4N-1,).

        A step that does not converge is cut in two, its halves too, `halvings` times deep.

        Raises:
            ConvergenceError: with the step's index and the last good state.
        """
        backend = self._backend
        solver = solver_of(method, dt, self._length, backend.lever)
        intervals, steps, _ = pressures.shape
        journey = _Journey(backend.place(state), load, linearise, method)
        x = np.empty((intervals + 1, backend.size))
        rate = np.empty((intervals + 1, backend.size))
        x[0], rate[0] = journey.place.x, journey.place.v
        begin = 0
        while begin < intervals * steps:
            piece = self._go(journey, (x, rate), pressures, begin, solver, None)
            begin = piece.done
            if not piece.failed_iterations:
                break
            interval, step = divmod(begin, steps)
            self._cut(journey, pressures[interval, step], solver, halvings, halvings, begin, piece)
            begin += 1
            if step == steps - 1:
                x[interval + 1], rate[interval + 1] = journey.place.x, journey.place.v
        final = backend.state(journey.place, state)
        return Run(
            backend.restore(x, state.q), backend.restore(rate, state.v), final,
            journey.iterations, _solved(journey) if linearise else None,
        )  # fmt: skip

    def _go(
        self, journey: _Journey, motion: tuple[Array, Array], pressures: Array, begin: int,
        solver: Solver, step: int | None,
    ) -> Piece:  # fmt: skip
        """Run the kernel from `begin` until it fails or ends, and gather what it recorded.

        The solves belong to the step `step`, or without it to the steps from `begin` on.
        """
        stages = len(solver.extrapolate)
        left = pressures.shape[0] * pressures.shape[1] - begin
        record = self._backend.new_record(left * stages if journey.linearise else 0)
        piece = self._backend.simulate(
            journey.place, motion, pressures, begin, solver, journey.load, record
        )
        journey.iterations += piece.iterations
        done = piece.done - begin
        if journey.linearise and done:
            journey.records.append(Record(*(part[: done * stages] for part in record)))
            journey.rates.append(np.full(done * stages, 1.0 / solver.h))
            journey.extrapolates.append(np.tile(solver.extrapolate, done))
            owners = np.arange(begin, piece.done) if step is None else np.full(done, step)
            journey.steps.append(np.repeat(owners, stages))
        return piece

    def _cut(
        self, journey: _Journey, u: Array, solver: Solver, halvings: int, allowed: int, step: int,
        piece: Piece,
    ) -> None:  # fmt: skip
        """Go over a step that failed in two halves, each of which may be cut again."""
        if halvings < 1:
            raise self._failure(journey, solver, allowed, step, piece)
        half = solver._replace(h=0.5 * solver.h)
        pressures = np.ascontiguousarray(np.broadcast_to(u, (1, 2, len(u))))
        motion = np.empty((2, self._backend.size)), np.empty((2, self._backend.size))
        begin = 0
        while begin < 2:
            part = self._go(journey, motion, pressures, begin, half, step)
            begin = part.done
            if part.failed_iterations:
                self._cut(journey, u, half, halvings - 1, allowed, step, part)
                begin += 1

    def _failure(
        self, journey: _Journey, solver: Solver, allowed: int, step: int, piece: Piece
    ) -> ConvergenceError:
        whole = solver.h / _STAGES[journey.method][0] * 2**allowed
        parts = f", also in {2**allowed} parts" if allowed else ""
        place = self._backend.state(journey.place, _no_state(self._backend.mesh.nodes))
        return ConvergenceError(
            f"step {step} of {whole:g} s ({journey.method}{parts}) did not converge in "
            f"{piece.failed_iterations} Newton iterations "
            f"(last update {piece.update:.3g} m): take a shorter step",
            step=step, residual=piece.update, iterations=piece.failed_iterations, state=place,
        )  # fmt: skip


def _no_state(nodes: int) -> RodState:
    zero = np.zeros(4 * nodes - 1)
    return RodState(zero, zero, np.tile([0.0, 1.0, 0.0], (nodes - 1, 1)), np.zeros(nodes))


def _solved(journey: _Journey) -> Solved:
    """Join the pieces of a run's linearisation."""
    if len(journey.records) == 1:
        record = journey.records[0]
    else:
        record = Record(*(np.concatenate(parts) for parts in zip(*journey.records, strict=True)))
    steps = np.concatenate(journey.steps)
    return Solved(
        record, np.concatenate(journey.rates), np.concatenate(journey.extrapolates), steps
    )


def find_equilibrium(backend: Backend, start: RodState, u: Array, load: Array) -> RodState:
    """Return the resting state under u (M,) [Pa] and load (4N-1,) [N], going there from `start`.

    Newton's method is tried on the whole load first. If it fails, the load is raised from zero in
    parts that shrink where it fails and grow where it works.

    Raises:
        ConvergenceError: the parts became too small.
    """
    tolerance = 1e-11 * float(backend.mesh.rest.sum())
    solver = Solver(
        h=1.0, extrapolate=np.ones(1), tolerance=tolerance, lever=0.0, limit=_STATIC_LIMIT
    )
    state, iterations, update = backend.solve_static(start, u, load, solver)
    if iterations > 0:
        return state
    state = RodState(start.q, 0.0 * start.v, start.directors, start.reference_twist)
    reached, part, spent = 0.0, 0.125, -iterations
    index = 0
    while reached < 1.0:
        target = min(1.0, reached + part)
        guess = state
        trial, iterations, update = backend.solve_static(guess, target * u, target * load, solver)
        spent += abs(iterations)
        if iterations > 0:
            state = trial
            reached = target
            part *= 2.0 if iterations < 8 else 1.0
            index += 1
            continue
        part *= 0.5
        if part < _SMALLEST_PART:
            raise ConvergenceError(
                f"no equilibrium beyond {reached:.4f} of the load (load step {index}, {spent} "
                f"Newton iterations, last update {update:.3g}): is it about to buckle or coil? "
                "Start from a nearer state or simulate with damping",
                step=index, residual=update, iterations=spent, state=state,
            )  # fmt: skip
    return state
