"""A simulated motion of a rod, and its exact linearisation by the pressures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.rod import step_kernel
from der_planner.rod.backend import Backend, RodState, positions_of
from der_planner.rod.mesh import array, by_step, require
from der_planner.rod.step_kernel import Record, SolveChain


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
        solved: the solves that it comes from.
    """

    intervals: int
    steps: int
    outputs: NDArray[np.int64]
    solved: Solved
    _chain: SolveChain
    _state_rows: NDArray[np.int64]

    @property
    def input_count(self) -> int:
        """M."""
        return int(self._chain.record.inputs.shape[2])

    def tangent(
        self, pressures: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None = None
    ) -> Array:
        """Return the change of the outputs (K+1, P) for a change of the pressures.

        Args:
            pressures: (K, M) held over the steps of an interval, or (K, S, M) [Pa].
            start: change of q[free] and v[free] at the beginning, each (F,).
        """
        change = by_step(pressures, self.steps, self.input_count)
        require(len(change) == self.intervals, "pressures", f"{self.intervals} rows", len(change))
        out = np.empty((self.intervals + 1, len(self.outputs)))
        step_kernel.tangent(change, self._initial(start), self._chain, out)
        return out

    def _initial(self, start: tuple[ArrayLike, ArrayLike] | None) -> Array:
        initial = np.zeros((2, len(self._chain.mass)))
        if start is not None:
            for row, value in enumerate(start):
                initial[row, self._state_rows] = array(value, self._state_rows.shape, "start")
        return initial

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
        step_kernel.sensitivity(shape, self.intervals, self.steps, 16, self._chain, out)
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


def linearisation_of(
    backend: Backend, solved: Solved, shape: tuple[int, int], outputs: NDArray[np.int64],
    rows: NDArray[np.int64]
) -> Linearisation:  # fmt: skip
    """Return the linearisation of solves in shape (K, S); rows are the outputs' in the kernels."""
    chain = chain_of(backend, solved, rows)
    return Linearisation(*shape, outputs, solved, chain, backend.free_rows)


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
