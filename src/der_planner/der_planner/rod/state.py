"""The state of a rod, and what is raised when the next one cannot be found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array


@dataclass(frozen=True)
class RodState:
    """Configuration and velocity of N nodes, with the frames that its angles count from.

    Attributes:
        q: (4N-1,) positions [m] and edge angles [rad]: x0, φ0, x1, φ1, …, x_{N-1}.
        v: (4N-1,) its rate [m/s, rad/s].
        directors: (N-1, 3) first reference director of each edge, time-parallel transported from
            the straight rod; φ is counted from it.
        reference_twist: (N,) twist of the reference frames at each node [rad] (node 0: against the
            ghost edge; the last entry is not used).
    """

    q: Array
    v: Array
    directors: Array
    reference_twist: Array

    @property
    def positions(self) -> Array:
        """(N, 3) node positions [m]."""
        return positions_of(self.q)

    @property
    def angles(self) -> Array:
        """(N-1,) edge angles φ [rad]."""
        return self.q[3::4].copy()


def positions_of(q: Array) -> Array:
    """Return the (…, N, 3) node positions of (…, 4N-1) configurations."""
    padded = np.concatenate([q, np.zeros((*q.shape[:-1], 1))], axis=-1)
    nodes = padded.shape[-1] // 4
    return padded.reshape(*q.shape[:-1], nodes, 4)[..., :3].copy()


class ConvergenceError(RuntimeError):
    """Newton's iteration did not converge; nothing wrong was returned.

    Attributes:
        step: index of the time step (or load step) that failed, 0 for a single step.
        residual: largest component of the last Newton update [m or rad].
        iterations: Newton iterations spent in the failed step.
        state: the last converged state, from which a caller may go on with a shorter step.
    """

    def __init__(
        self, message: str, *, step: int, residual: float, iterations: int, state: RodState
    ) -> None:
        super().__init__(message)
        self.step = step
        self.residual = residual
        self.iterations = iterations
        self.state = state
