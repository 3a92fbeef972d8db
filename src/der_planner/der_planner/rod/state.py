"""States and trajectories of a rod."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from der_planner.rod.linearisation import Linearisation

Array = NDArray[np.float64]
Arrays = tuple[Any, ...]


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


def positions_of(q: Array) -> Array:
    """Return the (…, N, 3) node positions of (…, 4N-1) configurations."""
    padded = np.concatenate([q, np.zeros((*q.shape[:-1], 1))], axis=-1)
    nodes = padded.shape[-1] // 4
    return padded.reshape(*q.shape[:-1], nodes, 4)[..., :3].copy()
