"""The exact linearisation of a simulated motion of the arcs, and what can be asked of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.pcc import kernels

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Linearisation:
    """First-order effect of pressures on the n bend angles along a motion of K intervals, S steps.

    Attributes:
        by_state: (K, S, 2n, 2n) of each step: the change of bend angles and rates after it by
            theirs before it.
        by_pressure: (K, S, 2n, n) by the pressures of the step [rad/Pa], [rad/s/Pa].
    """

    by_state: Vector
    by_pressure: Vector

    def tangent(self, pressures: Vector, start: Vector | None = None) -> Vector:
        """Return the change (K+1, n) of the bend angles [rad].

        Args:
            pressures: (K, S, n) change [Pa].
            start: (n,) change of the bend angles at the beginning [rad].
        """
        count, steps, size, n = self.by_pressure.shape
        x = np.zeros(size)
        if start is not None:
            x[:n] = start
        result = np.empty((count + 1, n))
        result[0] = x[:n]
        for k in range(count):
            for s in range(steps):
                x = self.by_state[k, s] @ x + self.by_pressure[k, s] @ pressures[k, s]
            result[k + 1] = x[:n]
        return result

    def adjoint(self, weights: Vector) -> tuple[Vector, Vector]:
        """Return the gradients of Σ weights · bend angles: by pressures and by those at the start.

        The transpose of `tangent`: (K, S, n) and (n,) for weights (K+1, n).
        """
        count, steps, size, n = self.by_pressure.shape
        x = np.zeros(size)
        gradient = np.empty((count, steps, n))
        for k in range(count - 1, -1, -1):
            x[:n] += weights[k + 1]
            for s in range(steps - 1, -1, -1):
                gradient[k, s] = self.by_pressure[k, s].T @ x
                x = self.by_state[k, s].T @ x
        return gradient, x[:n] + weights[0]

    def sensitivity(self, pulse: Vector | None = None) -> Vector:
        """Return ∂angle/∂input (K+1, n, K, n) [rad/Pa], zero where the input comes later.

        Args:
            pulse: (R, n) pressure in the R steps that follow the start of an interval when that
                interval's input is raised by one; None: one for the steps of the interval.
        """
        steps, n = self.by_pressure.shape[1], self.by_pressure.shape[3]
        shape = np.ones((steps, n)) if pulse is None else pulse
        matrix: Vector = kernels.sensitivity(self.by_state, self.by_pressure, shape)
        return matrix
