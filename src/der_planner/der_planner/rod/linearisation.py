"""The exact linearisation of a simulated motion and what can be asked of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.rod import sensitivity_kernel
from der_planner.rod.mesh import array
from der_planner.rod.state import Array


class StepFactors(NamedTuple):
    """The linearisation of every step, as the kernels keep it (see sensitivity_kernel).

    Attributes:
        factors: (steps, n, 2b+1) factored derivative of each step's residual.
        viscous: (steps or 0, n, b+1) viscous matrix times rate.
        inputs: (steps, n, M) B(q)Λ.
        inertia: (n,) M·rate² + D·rate. momentum: (n,) M·rate; both zero where fixed.
        rate: 1/h. extrapolate: (P,) factors e of the stages.
    """

    factors: Array
    viscous: Array
    inputs: Array
    inertia: Array
    momentum: Array
    rate: float
    extrapolate: Array


class StageStates(NamedTuple):
    """The states at which the steps were linearised.

    Attributes:
        states: (steps, 3, n) position, velocity and acceleration of each solution.
        pressures: (steps, M). load: (4N-1,) gravity and point forces.
    """

    states: Array
    pressures: Array
    load: Array


@dataclass(frozen=True)
class Linearisation:
    """First-order effect of the pressures on P outputs along a simulated motion of K intervals.

    A product with the K·P × K·M sensitivity (`tangent`) or its transpose (`adjoint`) costs about as
    much as the simulation's linear solves; the matrix itself (`sensitivity`) K/2 times as much, at
    vector speed. Both ways are exact for the discrete motion.

    Attributes:
        intervals: K. steps: S, integrator steps in an interval.
        stages: of one integrator step.
        outputs: (P,) indices into q.
        state_indices: indices into q of the free degrees of freedom, for `start` arguments.
    """

    intervals: int
    steps: int
    stages: int
    outputs: NDArray[np.int64]
    state_indices: NDArray[np.int64]
    _stored: StepFactors
    _output_rows: NDArray[np.int64]
    _state_rows: NDArray[np.int64]
    _stages: StageStates

    @property
    def input_count(self) -> int:
        """M."""
        return int(self._stored.inputs.shape[2])

    @property
    def rate(self) -> float:
        """1/h of the stages [1/s]."""
        return self._stored.rate

    @property
    def stage_states(self) -> StageStates:
        """The states at which the steps were linearised."""
        return self._stages

    def tangent(
        self, pressures: ArrayLike, start: tuple[ArrayLike, ArrayLike] | None = None
    ) -> Array:
        """Return the change of the outputs (K+1, P) for a change of the pressures.

        Args:
            pressures: (K, M) held over the steps of an interval, or (K, S, M) [Pa].
            start: change of q[free] and v[free] at the beginning, each (F,).
        """
        return self._propagate(self._by_step(pressures), self._stored, start)

    def forced(self, forcing: Array, start: tuple[ArrayLike, ArrayLike] | None = None) -> Array:
        """Return the change of the outputs (K+1, P) for forces (steps, n) added in each step."""
        stored = self._stored._replace(inputs=np.ascontiguousarray(forcing[:, :, None]))
        once = np.ones((self.intervals, self.steps * self.stages, 1))
        return self._propagate(once, stored, start)

    def _propagate(
        self, change: Array, stored: StepFactors, start: tuple[ArrayLike, ArrayLike] | None
    ) -> Array:
        initial = np.zeros((2, stored.inertia.shape[0]))
        if start is not None:
            for row, value in enumerate(start):
                initial[row, self._state_rows] = array(value, self._state_rows.shape, "start")
        out = np.empty((self.intervals + 1, len(self.outputs)))
        sensitivity_kernel.tangent(change, initial, *stored, self._output_rows, out)
        return out

    def adjoint(self, weights: ArrayLike, *, by_step: bool = False) -> Array:
        """Return the gradient of Σ weights·outputs by the pressures: the transpose of `tangent`.

        Args:
            weights: (K+1, P).
            by_step: keep one row for each step, (K, S, M), instead of (K, M).
        """
        weight = array(weights, (self.intervals + 1, len(self.outputs)), "weights")
        gradient = np.empty((self.intervals, self.steps * self.stages, self.input_count))
        start = np.empty((2, self._stored.inertia.shape[0]))
        sensitivity_kernel.adjoint(weight, *self._stored, self._output_rows, gradient, start)
        if not by_step:
            total: Array = gradient.sum(axis=1)
            return total
        of_steps: Array = gradient.reshape(self.intervals, self.steps, self.stages, -1).sum(axis=2)
        return of_steps

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
        sensitivity_kernel.sensitivity(
            np.repeat(shape, self.stages, axis=0),
            self.intervals,
            16,
            *self._stored,
            self._output_rows,
            out,
        )
        return out

    def _by_step(self, pressures: ArrayLike) -> Array:
        given = np.asarray(pressures, dtype=np.float64)
        if given.ndim == 2:
            held = array(given, (self.intervals, self.input_count), "pressures")
            return np.repeat(held[:, None, :], self.steps * self.stages, axis=1)
        by_step = array(given, (self.intervals, self.steps, self.input_count), "pressures")
        return np.repeat(by_step, self.stages, axis=1)


def step_matrices(stored: StepFactors, rows: NDArray[np.int64]) -> tuple[Array, Array]:
    """Return A (2F, 2F) and B (2F, M) of all stored stages under one input, on `rows`."""
    size = stored.inertia.shape[0]
    count = len(rows)
    columns = 2 * count + stored.inputs.shape[2]
    dq = np.zeros((size, columns))
    dv = np.zeros((size, columns))
    dq[rows, np.arange(count)] = 1.0
    dv[rows, np.arange(count, 2 * count)] = 1.0
    for stage in range(len(stored.factors)):
        y = np.zeros((size, columns))
        y[:, 2 * count :] = stored.inputs[stage]
        viscous = stored.viscous[stage] if len(stored.viscous) else np.empty((0, 1))
        sensitivity_kernel.advance(
            dq, dv, y, stored.factors[stage], viscous, stored.inertia, stored.momentum, stored.rate,
            float(stored.extrapolate[stage]),
        )  # fmt: skip
    both = np.concatenate([dq[rows], dv[rows]])
    return both[:, : 2 * count], both[:, 2 * count :]
