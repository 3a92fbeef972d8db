"""Resting states, by Newton's method and load stepping."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from der_planner.rod.errors import ConvergenceError
from der_planner.rod.mesh import Mesh
from der_planner.rod.state import Array, RodState
from der_planner.rod.step_kernel import Solver

_LIMIT = 40
_SMALLEST_PART = 1.0 / 4096.0


class StaticSolver(Protocol):
    """What `find_equilibrium` needs of a backend."""

    mesh: Mesh

    def solve_static(
        self, start: RodState, u: Array, load: Array, solver: Solver
    ) -> tuple[RodState, int, float]:
        """Solve the balance of forces; iterations are negative without convergence."""
        ...


def find_equilibrium(backend: StaticSolver, start: RodState, u: Array, load: Array) -> RodState:
    """Return the resting state under u (M,) [Pa] and load (4N-1,) [N], going there from `start`.

    Newton's method is tried on the whole load first. If it fails, the load is raised from zero in
    parts that shrink where it fails and grow where it works.

    Raises:
        ConvergenceError: the parts became too small.
    """
    tolerance = 1e-11 * float(backend.mesh.rest.sum())
    solver = Solver(h=1.0, extrapolate=np.ones(1), tolerance=tolerance, lever=0.0, limit=_LIMIT)
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
