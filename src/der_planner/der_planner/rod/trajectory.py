"""A simulated motion of a rod."""

from __future__ import annotations

from dataclasses import dataclass

from der_planner.rod.linearisation import Linearisation
from der_planner.rod.state import Array, RodState, positions_of


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
