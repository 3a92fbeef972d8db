"""Time integration and statics.

Each method is a chain of backward Euler solves; a step that does not converge may be cut. A resting
state is found by Newton's method, with load stepping where that fails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.rod import step_kernel
from der_planner.rod.backend import Backend, ConvergenceError, Piece, RodState, positions_of
from der_planner.rod.mesh import array, by_step, require
from der_planner.rod.step_kernel import Record, SolveChain, Solver

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
        count = self.intervals
        out = np.zeros((count + 1, len(self.outputs), count * self.input_count))
        step_kernel.sensitivity(shape, count, self.steps, 16, self.chain, out)
        return out.reshape(*out.shape[:2], count, self.input_count)


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


def step_matrices(chain: SolveChain) -> tuple[Array, Array]:
    """Return A (2F, 2F) and B (2F, M) of all solves under one input; their outputs are free."""
    rows, count = chain.outputs, len(chain.outputs)
    shape = (len(chain.mass), 2 * count + chain.record.inputs.shape[2])
    dq, dv, before = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    dq[rows, np.arange(count)] = 1.0
    dv[rows, np.arange(count, 2 * count)] = 1.0
    for solve in range(len(chain.steps)):
        y = np.zeros(shape)
        y[:, 2 * count :] = chain.record.inputs[solve]
        step_kernel.advance(solve, dq, dv, y, before, chain)
    both = np.concatenate([dq[rows], dv[rows]])
    return both[:, : 2 * count], both[:, 2 * count :]


def integrate(
    backend: Backend, state: RodState, pressures: Array, dt: float, method: str, load: Array,
    outputs: NDArray[np.int64] | None = None, halvings: int = 0,
) -> tuple[Trajectory, SolveChain | None]:  # fmt: skip
    """Run K intervals of S steps of dt under pressures (K, S, M) and load (4N-1,).

    A step that does not converge is taken in two parts, then in four, up to 2 ** halvings.

    Returns:
        The motion, and its solves if rows of outputs are given.

    Raises:
        ValueError: an unknown method.
        ConvergenceError: with the step's index and the last good state.
    """
    require(method in _STAGES, "method", f"one of {sorted(_STAGES)}", method)
    fraction, extrapolate = _STAGES[method]
    solver = Solver(dt * fraction, extrapolate, 1e-10 * backend.length, backend.lever, _LIMIT)
    intervals, steps, _ = pressures.shape
    linearise, place = outputs is not None, backend.place(state)
    x, rate = np.empty((2, intervals + 1, backend.size))
    x[0], rate[0] = place.x, place.v
    spent, begin, pieces = 0, 0, []
    while begin < intervals * steps:
        piece = backend.simulate(place, (x, rate), pressures, begin, solver, load, linearise)
        if linearise:
            pieces.append(_recorded(piece, solver, np.arange(begin, piece.done)))
        spent, begin, parts = spent + piece.iterations, piece.done, 1
        before = backend.state(place, state) if piece.failed_iterations else state
        while piece.failed_iterations:
            if parts == 2**halvings:
                cut = f", also in {parts} parts" if parts > 1 else ""
                raise ConvergenceError(
                    f"step {begin} of {dt:g} s ({method}{cut}) did not converge in "
                    f"{piece.failed_iterations} Newton iterations "
                    f"(last update {piece.update:.3g} m): take a shorter step",
                    step=begin, residual=piece.update, iterations=piece.failed_iterations,
                    state=before,
                )  # fmt: skip
            parts *= 2
            place, short = backend.place(before), solver._replace(h=solver.h / parts)
            inputs = np.repeat(pressures[divmod(begin, steps)][None, None], parts, axis=1)
            motion = np.empty((2, backend.size)), np.empty((2, backend.size))
            piece = backend.simulate(place, motion, inputs, 0, short, load, linearise)
            spent += piece.iterations
        if parts > 1:
            if linearise:
                pieces.append(_recorded(piece, short, np.full(parts, begin)))
            begin += 1
            if begin % steps == 0:
                x[begin // steps], rate[begin // steps] = place.x, place.v
    trajectory = Trajectory(
        steps * dt * np.arange(intervals + 1), backend.restore(x, state.q),
        backend.restore(rate, state.v), backend.state(place, state), spent,
    )  # fmt: skip
    return trajectory, None if outputs is None else _chain(backend, pieces, outputs)


def _recorded(
    piece: Piece, solver: Solver, owners: NDArray[np.int64]
) -> tuple[Record, Array, Array, NDArray[np.int64]]:
    """Return what a piece recorded, as `SolveChain` has it; the steps of its solves are owners."""
    stages = len(solver.extrapolate)
    count = stages * len(owners)
    record = Record(*(part[:count] for part in piece.record))
    extrapolate = np.tile(solver.extrapolate, len(owners))
    return record, np.full(count, 1.0 / solver.h), extrapolate, np.repeat(owners, stages)


def _chain(
    backend: Backend,
    pieces: list[tuple[Record, Array, Array, NDArray[np.int64]]],
    outputs: NDArray[np.int64],
) -> SolveChain:
    """Return the solves of a run, which has several pieces if steps of it were cut."""
    mass, damping = backend.mass.copy(), backend.damping.copy()
    mass[backend.fixed] = damping[backend.fixed] = 0.0
    record, rates, extrapolate, steps = pieces[0]
    if len(pieces) > 1:
        records, *others = zip(*pieces, strict=True)
        record = Record(*map(np.concatenate, zip(*records, strict=True)))
        rates, extrapolate, steps = map(np.concatenate, others)
    return SolveChain(record, mass, damping, rates, extrapolate, steps, outputs)


def find_equilibrium(backend: Backend, start: RodState, u: Array, load: Array) -> RodState:
    """Return the resting state under u (M,) [Pa] and load (4N-1,) [N], going there from `start`.

    Newton's method is tried on the whole load first. If it fails, the load is raised from zero in
    parts that shrink where it fails and grow where it works.

    Raises:
        ConvergenceError: the parts became too small.
    """
    edges, length = backend.mesh.rest, backend.length
    # An iteration moves nodes by at most twice the shortest edge.
    limit = _STATIC_LIMIT + round(0.5 * length * float(1.0 / edges.min() - 1.0 / edges.mean()))
    solver = Solver(1.0, np.ones(1), 1e-11 * length, backend.lever, limit)
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
