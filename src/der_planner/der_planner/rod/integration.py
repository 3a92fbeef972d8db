"""Time integration and statics.

Each method is a chain of backward Euler solves; a step that does not converge may be cut. A resting
state is found by Newton's method, with load stepping where that fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.rod import step_kernel
from der_planner.rod.backend import Backend, ConvergenceError, Piece, RodState, positions_of
from der_planner.rod.mesh import array, by_step, require
from der_planner.rod.step_kernel import Place, Record, SolveChain, Solver

Method = Literal["sdirk2", "midpoint", "backward_euler"]

_LIMIT = 30  # most Newton iterations of a solve in time
_STATIC_LIMIT = 40  # most Newton iterations of a solve at rest, with edges of one length
_SMALLEST_PART = 1.0 / 4096.0  # of a load that is raised in parts
_GAMMA = 1.0 - math.sqrt(0.5)
# fraction of the step that a solve goes over, and e of each solve: see step_kernel
_STAGES = {
    "backward_euler": (1.0, np.array([1.0])),
    "midpoint": (0.5, np.array([2.0])),
    "sdirk2": (_GAMMA, np.array([(1.0 - _GAMMA) / _GAMMA, 1.0])),
}


class Solved(NamedTuple):
    """The recorded solves of a simulation in their order; a step that was cut has more of them.

    Attributes:
        record: the linearisation of each solve.
        rates: (solves,) 1/h. extrapolate: (solves,) e.
        steps: (solves,) index of the integrator step that each belongs to.
    """

    record: Record
    rates: Array
    extrapolate: Array
    steps: NDArray[np.int64]


@dataclass(frozen=True)
class Linearisation:
    """First-order effect of the pressures on P outputs along a simulated motion of K intervals.

    A product with the K·P × K·M sensitivity (`tangent`) costs about as much as the simulation's
    linear solves; the matrix itself (`sensitivity`) K/2 times as much, at vector speed. Both are
    exact for the discrete motion.

    In space an output that is an angle counts from frames transported from those of the simulated
    motion, as `Rod.state(q, like=…)` does; positions do not depend on frames.

    Attributes:
        intervals: K. steps: S, integrator steps in an interval.
        outputs: (P,) indices into q.
        chain: the solves that it comes from.
        state_rows: (F,) unknowns of the kernels that are free.
    """

    intervals: int
    steps: int
    outputs: NDArray[np.int64]
    chain: SolveChain
    state_rows: NDArray[np.int64]

    @property
    def input_count(self) -> int:
        """M."""
        return int(self.chain.record.inputs.shape[2])

    def tangent(
        self, pressures: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None = None
    ) -> Array:
        """Return the change of the outputs (K+1, P) for a change of the pressures.

        Args:
            pressures: (K, M) held over the steps of an interval, or (K, S, M) [Pa]; or C changes
                at once, which takes less time, (K, S, M, C) for outputs (K+1, P, C).
            start: change of q[free] and v[free] at the beginning, each (F,) or (F, C).
        """
        given = np.asarray(pressures, dtype=float)
        if alone := given.ndim < 4:
            given = by_step(given, self.steps, self.input_count)[..., None]
        shape, columns = (self.intervals, self.steps, self.input_count), given.shape[3]
        change = array(given, (*shape, columns), "pressures")
        initial = np.zeros((2, len(self.chain.mass), columns))
        if start is not None:
            rows = (len(self.state_rows),) if alone else (len(self.state_rows), columns)
            for row, value in enumerate(start):
                found = array(value, rows, "start")
                initial[row, self.state_rows] = found[:, None] if alone else found
        out = np.empty((self.intervals + 1, len(self.outputs), columns))
        step_kernel.tangent(change, initial, self.chain, out)
        return out[..., 0] if alone else out

    def sensitivity(self, pulse: ArrayLike | None = None) -> Array:
        """Return ∂output/∂input (K+1, P, K, M) [m/Pa], zero where the input comes later.

        Args:
            pulse: (R, M) pressure in the R integrator steps that follow the start of an interval
                when that interval's setpoint is raised by one: the response of the pneumatics, for
                instance. Default: one for the S steps of the interval, zero later.
        """
        if pulse is None:
            shape = np.ones((self.steps, self.input_count))
        else:
            rows = np.shape(pulse)[0] if np.ndim(pulse) else 0
            shape = array(pulse, (rows, self.input_count), "pulse")
        out = np.zeros((self.intervals + 1, len(self.outputs), self.intervals, self.input_count))
        step_kernel.sensitivity(shape, self.intervals, self.steps, 16, self.chain, out)
        return out


@dataclass(frozen=True)
class Trajectory:
    """A simulated motion: K intervals, K + 1 samples (the initial state is sample 0).

    Attributes:
        time: (K+1,) time since the initial state [s].
        q: (K+1, 4N-1) configurations, as in `RodState`.
        v: (K+1, 4N-1) velocities.
        final: the last state, from which `simulate` can go on.
        newton_iterations: Newton iterations of all steps together.
        linearisation: sensitivities along the motion, if asked for.
    """

    time: Array
    q: Array
    v: Array
    final: RodState
    newton_iterations: int
    linearisation: Linearisation | None = None

    @property
    def positions(self) -> Array:
        """(K+1, N, 3) node positions [m]."""
        return positions_of(self.q)

    @property
    def tip(self) -> Array:
        """(K+1, 3) position of the last node [m]."""
        return self.q[:, -3:].copy()


def chain_of(backend: Backend, solved: Solved, rows: NDArray[np.int64]) -> SolveChain:
    """Return recorded solves as the kernels take them."""
    mass, damping = backend.mass.copy(), backend.damping.copy()
    mass[backend.fixed] = damping[backend.fixed] = 0.0
    return SolveChain(
        solved.record, mass, damping, solved.rates, solved.extrapolate, solved.steps, rows
    )


def step_matrices(backend: Backend, solved: Solved) -> tuple[Array, Array]:
    """Return A (2F, 2F) and B (2F, M) of all recorded solves under one input."""
    rows = backend.free_rows
    chain = chain_of(backend, solved, rows)
    count = len(rows)
    shape = (backend.size, 2 * count + solved.record.inputs.shape[2])
    dq, dv, before = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    dq[rows, np.arange(count)] = 1.0
    dv[rows, np.arange(count, 2 * count)] = 1.0
    for solve in range(len(solved.steps)):
        y = np.zeros(shape)
        y[:, 2 * count :] = solved.record.inputs[solve]
        step_kernel.advance(solve, dq, dv, y, before, chain)
    both = np.concatenate([dq[rows], dv[rows]])
    return both[:, : 2 * count], both[:, 2 * count :]


@dataclass
class _Journey:
    """A run under way: its beginning, its state and its recorded samples."""

    begin: RodState
    place: Place
    load: Array
    linearise: bool
    method: str
    iterations: int = 0
    pieces: list[Solved] = field(default_factory=list)


class Integrator:
    """Runs a backend by one of the methods."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._length = float(backend.mesh.rest.sum())

    def run(
        self, state: RodState, pressures: Array, dt: float, method: str, load: Array,
        linearise: bool = False, halvings: int = 0,
    ) -> tuple[Trajectory, Solved | None]:  # fmt: skip
        """Run K intervals of S steps of dt under pressures (K, S, M) and load (4N-1,).

        Returns:
            The motion, and what its linearisation comes from, if that was asked for.

        A step that does not converge is cut in two, its halves too, `halvings` times deep.

        Raises:
            ValueError: an unknown method.
            ConvergenceError: with the step's index and the last good state.
        """
        backend = self._backend
        require(method in _STAGES, "method", f"one of {sorted(_STAGES)}", method)
        fraction, extrapolate = _STAGES[method]
        solver = Solver(
            dt * fraction, extrapolate, 1e-10 * self._length, backend.lever, limit=_LIMIT
        )
        intervals, steps, _ = pressures.shape
        journey = _Journey(state, backend.place(state), load, linearise, method)
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
        motion = Trajectory(
            steps * dt * np.arange(intervals + 1), backend.restore(x, state.q),
            backend.restore(rate, state.v), backend.state(journey.place, state), journey.iterations,
        )  # fmt: skip
        return motion, _joined(journey.pieces) if linearise else None

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
            owners = np.arange(begin, piece.done) if step is None else np.full(done, step)
            journey.pieces.append(
                Solved(
                    record=Record(*(part[: done * stages] for part in record)),
                    rates=np.full(done * stages, 1.0 / solver.h),
                    extrapolate=np.tile(solver.extrapolate, done),
                    steps=np.repeat(owners, stages),
                )
            )
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
        place = self._backend.state(journey.place, journey.begin)
        return ConvergenceError(
            f"step {step} of {whole:g} s ({journey.method}{parts}) did not converge in "
            f"{piece.failed_iterations} Newton iterations "
            f"(last update {piece.update:.3g} m): take a shorter step",
            step=step, residual=piece.update, iterations=piece.failed_iterations, state=place,
        )  # fmt: skip


def _joined(pieces: list[Solved]) -> Solved:
    """Join the pieces of a run's linearisation."""
    if len(pieces) == 1:
        return pieces[0]
    records, *others = zip(*pieces, strict=True)
    record = Record(*(np.concatenate(parts) for parts in zip(*records, strict=True)))
    return Solved(record, *map(np.concatenate, others))


def find_equilibrium(backend: Backend, start: RodState, u: Array, load: Array) -> RodState:
    """Return the resting state under u (M,) [Pa] and load (4N-1,) [N], going there from `start`.

    Newton's method is tried on the whole load first. If it fails, the load is raised from zero in
    parts that shrink where it fails and grow where it works.

    Raises:
        ConvergenceError: the parts became too small.
    """
    edges = backend.mesh.rest
    length = float(edges.sum())
    # An iteration moves nodes by at most twice the shortest edge.
    limit = _STATIC_LIMIT + round(0.5 * length * float(1.0 / edges.min() - 1.0 / edges.mean()))
    solver = Solver(h=1.0, extrapolate=np.ones(1), tolerance=1e-11 * length, lever=0.0, limit=limit)
    state, iterations, update = backend.solve_static(start, u, load, solver)
    if iterations > 0:
        return state
    state = RodState(start.q, 0.0 * start.v, start.directors, start.reference_twist)
    reached, part, spent = 0.0, 0.125, -iterations
    index = 0
    while reached < 1.0:
        target = min(1.0, reached + part)
        trial, iterations, update = backend.solve_static(state, target * u, target * load, solver)
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
