"""Resting states: even bending in closed form, equilibria by Newton's method and load stepping."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from der_planner.rod.errors import ConvergenceError
from der_planner.rod.mesh import Mesh
from der_planner.rod.state import Array, RodState, positions_of
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


def turning(q: Array, segments: tuple[tuple[int, int], ...]) -> Array:
    """Return (…, M) the turning about z of each segment from its first to its last edge [rad]."""
    edges = np.diff(positions_of(q), axis=-2)
    e, f = edges[..., :-1, :], edges[..., 1:, :]
    sine = e[..., 0] * f[..., 1] - e[..., 1] * f[..., 0]
    cosine = e[..., 0] * f[..., 0] + e[..., 1] * f[..., 1]
    turns = np.arctan2(sine, cosine)
    result = np.zeros((*q.shape[:-1], len(segments)))
    for index, (first, count) in enumerate(segments):
        result[..., index] = turns[..., first : first + count - 2].sum(axis=-1)
    return result


def even_bend(angles: Array, mesh: Mesh) -> tuple[Array, Array]:
    """Return q (4N-1,) and S = ∂q/∂angles (4N-1, M) of segments that bend evenly in the xy plane.

    Each of a segment's inner nodes turns by the same angle, everything else is straight and
    unstretched: where the rod rests under constant pressures without loads (Corollary 1 of the
    paper).
    """
    nodes = mesh.nodes
    share = np.zeros((nodes, len(angles)))
    for index, (first, count) in enumerate(mesh.segments):
        share[first + 1 : first + count - 1, index] = 1.0 / (count - 2)
    direction_by_angle = np.cumsum(share, axis=0)[:-1]
    direction = direction_by_angle @ angles
    step = mesh.rest[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    turned = np.stack([-step[:, 1], step[:, 0]], axis=1)
    q = np.zeros(4 * nodes - 1)
    q[0::4] = mesh.base
    tangent = np.zeros((4 * nodes - 1, len(angles)))
    for axis in range(2):
        q[4 + axis :: 4] += np.cumsum(step[:, axis])
        tangent[4 + axis :: 4] = np.cumsum(turned[:, axis, None] * direction_by_angle, axis=0)
    return q, tangent
