"""State, arrays and compiled kernels of one rod: what rods in a plane and in space share.

The kernels know some coordinates only (in a plane two a node), and with a ghost clamp one node
more, before the others. A backend goes between their unknowns and the public layout q in R^(4N-1).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod import banded_kernel, step_kernel
from der_planner.rod.mesh import Mesh
from der_planner.rod.step_kernel import Base, Body, Place, Record, Solver

_NO_FRAMES = Base(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


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


def positions_of(q: Array) -> Array:
    """Return the (…, N, 3) node positions of (…, 4N-1) configurations."""
    padded = np.concatenate([q, np.zeros((*q.shape[:-1], 1))], axis=-1)
    return padded.reshape(*q.shape[:-1], padded.shape[-1] // 4, 4)[..., :3].copy()


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


class Piece(NamedTuple):
    """What one call of a simulation kernel did."""

    done: int  # index of the step that failed, or the number of all steps
    iterations: int  # Newton iterations
    update: float  # size of the last update [m]
    failed_iterations: int  # of the solve that failed, 0 if none did
    record: Record  # the linearisation; only the solves of the steps done are filled


class Kernels(NamedTuple):
    """The compiled functions of one kind of rod, by their names."""

    simulate: Callable[..., Any]
    newton: Callable[..., Any]
    linearise: Callable[..., Any]
    energy: Callable[..., Any]
    assemble: Callable[..., Any]


class Backend(ABC):
    """What integration, linearisation and statics need of a rod; planar or spatial.

    Attributes:
        mesh: the numbers of the rod. length: of all its edges [m].
        index: indices into q of the coordinates that the kernels have.
        offset: unknowns of the ghost node, before those of q.
        size: n, unknowns of the kernels.
        fixed: unknowns that do not move.
        free: indices into q that move. free_rows: the same as unknowns.
        mass: (n,). damping: (n,).
        unknowns_per_node: 2 in a plane, 4 in space.
        turning_edges: edges whose angle counts from a frame that turns; none in a plane.
        lever: an angle counts times this as a length in a Newton update [m].
        rod: the named tuple of numbers that the kernels take; a subclass fills it.
    """

    kernels: Kernels
    unknowns_per_node: int
    turning_edges = 0
    lever = 0.0
    rod: Any

    def __init__(self, mesh: Mesh, index: NDArray[np.int64]) -> None:
        self.mesh, self.length = mesh, float(mesh.rest.sum())
        self.index = index
        self.offset = self.unknowns_per_node * int(mesh.ghost)
        self.size = len(index) + self.offset
        clamped = set(mesh.clamped.tolist())
        fixed = [k + self.offset for k, d in enumerate(index) if d in clamped]
        self.fixed = np.array([*range(self.offset), *fixed], dtype=np.int64)
        self.free = np.array([d for d in index if d not in clamped], dtype=np.int64)
        self.free_rows = self.rows(self.free)
        self.mass = self.rates(mesh.mass_diagonal)
        self.damping = self.rates(mesh.damping_diagonal)

    # ------------------------------------------------------- what a plane and space do differently

    @abstractmethod
    def work_space(self, base: Base) -> Any:
        """Return new work arrays for kernels that start from these frames."""

    def frames(self, state: RodState) -> Base:  # noqa: ARG002 - a plane has none
        """Return copies of the reference frames of a state, with the ghost edge's."""
        return _NO_FRAMES

    def public_state(self, q: Array, v: Array, base: Base, like: RodState) -> RodState:  # noqa: ARG002
        """Return the state at q, v with frames of the kernels, or as in `like` in a plane."""
        return replace(like, q=q, v=v)

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q whose frames are those of `base`, transported where they turn."""
        return replace(base, q=q, v=v)

    @abstractmethod
    def framed(self, state: RodState) -> tuple[Array, Any, Array]:
        """Return the unknowns of a state, a work space of it, and its edges.

        Each row of the edges, which are part of the work space, begins with the tangent.
        """

    # ------------------------------------------------------------------------------ coordinates

    def ghosted(self, values: Array) -> Array:
        """Return values of edges or nodes after a zero for what the ghost clamp adds."""
        return np.concatenate([np.zeros((int(self.mesh.ghost), *values.shape[1:])), values])

    def numbers(self) -> dict[str, Any]:
        """Return the numbers that all rods have alike, with those of the ghost's edge or node."""
        mesh, ghost = self.mesh, int(self.mesh.ghost)
        first, count = np.array(mesh.segments, dtype=np.int64).reshape(-1, 2).T
        of_nodes = {
            name: self.ghosted(getattr(mesh, name)) for name in ("bend", "cubic", "viscous")
        }
        return of_nodes | {
            "rest": np.concatenate([mesh.rest[:ghost], mesh.rest]),
            "shortest": float(mesh.rest.min()),
            "axial": self.ghosted(mesh.axial),
            "first": first + ghost,
            "last": first + ghost + count - 2,
            "body": Body(self.mass, self.damping, np.zeros(self.size), self.fixed),
        }

    def unknowns(self, q: Array) -> Array:
        """Return the kernels' coordinates (n,) of q (4N-1,)."""
        own: Array = q[self.index]
        ghost = own[: self.offset].copy()
        if self.offset:
            ghost[0] -= self.mesh.rest[0]
            ghost[3:] = 0.0
        return np.concatenate([ghost, own])

    def rates(self, v: Array) -> Array:
        """Return a velocity or force (4N-1,) in the kernels' coordinates (n,)."""
        return np.concatenate([np.zeros(self.offset), v[self.index]])

    def rows(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the unknowns at indices into q; -1 for what the kernels do not have."""
        lookup = {int(d): k + self.offset for k, d in enumerate(self.index)}
        return np.array([lookup.get(int(d), -1) for d in indices], dtype=np.int64)

    def restore(self, x: Array, base: Array) -> Array:
        """Return (…, 4N-1) from unknowns (…, n); what they lack is as in `base` (4N-1,)."""
        result = np.broadcast_to(base, (*x.shape[:-1], base.shape[0])).copy()
        result[..., self.index] = x[..., self.offset :]
        return result

    def full(self, values: Array) -> Array:
        """Return (4N-1, …) from values of the unknowns (n, …), zero where there are none."""
        result = np.zeros((4 * self.mesh.nodes - 1, *values.shape[1:]))
        result[self.index] = values[self.offset :]
        return result

    def full_matrix(self, matrix: Array) -> Array:
        """Return (4N-1, 4N-1) from a matrix (n, n) of the unknowns."""
        return self.full(self.full(matrix).T).T

    def place(self, state: RodState) -> Place:
        """Return a state in the kernels' coordinates, free to be changed."""
        return Place(self.unknowns(state.q), self.rates(state.v), self.frames(state))

    def state(self, place: Place, like: RodState) -> RodState:
        """Return the public state at a place; what a plane does not have is as in `like`."""
        q, v = self.restore(place.x, like.q), self.restore(place.v, like.v)
        return self.public_state(q, v, place.base, like)

    # ---------------------------------------------------------------------------------- kernels

    def loaded(self, load: Array) -> Any:
        """Return the numbers of the rod under a load (4N-1,) [N]."""
        return self.rod._replace(body=self.rod.body._replace(load=self.rates(load)))

    def _new_record(self, solves: int) -> Record:
        """Return an unfilled record of so many solves."""
        band = (self.size, 5 * self.unknowns_per_node + 1)
        edges = self.turning_edges
        gauges = solves if edges else 0
        drags = solves if edges or self.mesh.viscous.any() else 0
        return Record(
            factors=np.empty((solves, *band)),
            back=np.empty((drags, *band)),
            inputs=np.empty((solves, self.size, len(self.mesh.gain))),
            gauge=np.empty((gauges, edges, 6)),
        )

    def simulate(
        self, place: Place, motion: tuple[Array, Array], pressures: Array, begin: int,
        solver: Solver, load: Array, linearise: bool,
    ) -> Piece:  # fmt: skip
        """Run the kernel from step `begin` on; motion is where positions and velocities go."""
        left = pressures.shape[0] * pressures.shape[1] - begin
        record = self._new_record(left * len(solver.extrapolate) if linearise else 0)
        space = self.work_space(place.base)
        done, iterations, update, failed = self.kernels.simulate(
            motion, place, pressures, begin, solver, record, space, self.loaded(load)
        )
        return Piece(done, iterations, update, failed, record)

    def solve_static(
        self, start: RodState, u: Array, load: Array, solver: Solver
    ) -> tuple[RodState, int, float]:
        """Solve the balance of forces from `start`; iterations are negative without convergence."""
        x, base = self.unknowns(start.q), self.frames(start)
        iterations, update = self.kernels.newton(
            x, x.copy(), np.zeros(self.size), 0.0, u, solver, self.work_space(base),
            self.loaded(load),
        )  # fmt: skip
        if iterations < 0:
            return start, iterations, update
        q = self.restore(x, start.q)
        return self.public_state(q, 0.0 * q, base, start), iterations, update

    def linearise_equilibrium(self, state: RodState, u: Array) -> Array:
        """Return ∂q/∂u (4N-1, M) of a resting state."""
        band, columns = self._static(state, u)
        banded_kernel.factor_general(band)
        banded_kernel.solve_columns(band, columns)
        return self.full(columns)

    def static_stiffness(self, state: RodState, u: Array) -> Array:
        """Return −∂(F_int + B Λ u)/∂q (4N-1, 4N-1); rows of what is held are those of a unit."""
        return self.full_matrix(general_band_to_dense(self._static(state, u)[0]))

    def _static(self, state: RodState, u: Array) -> tuple[Array, Array]:
        x, space = self.unknowns(state.q), self.work_space(self.frames(state))
        columns = np.zeros((self.size, len(u)))
        self.kernels.linearise(x, x, 0.0, u, columns, space, self.rod)
        return space.a, columns

    def energy(self, state: RodState) -> float:
        """Return the elastic energy [J]."""
        x, space, _ = self.framed(state)
        return float(self.kernels.energy(x, space, self.rod))

    def internal_force(self, state: RodState) -> Array:
        """Return the elastic and viscous force (4N-1,) of a moving state."""
        return -self.full(self._assembled(state, self.rates(state.v))[0])

    def stiffness(self, state: RodState) -> Array:
        """Return ∇²E (4N-1, 4N-1), frames re-based at the state; entries off a plane are zero."""
        _, space = self._assembled(state, np.zeros(self.size))
        banded_kernel.expand(space.s, space.a)
        return self.full_matrix(general_band_to_dense(space.a))

    def _assembled(self, state: RodState, v: Array) -> tuple[Array, Any]:
        """Return ∇E with the viscous force at velocities v (n,), and the work space then."""
        x, space, _ = self.framed(state)
        gradient, unpressed = np.zeros(self.size), np.zeros(len(self.mesh.gain))
        self.kernels.assemble(x, v, 0.0, unpressed, False, gradient, space, self.rod)
        return gradient, space

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        columns = np.zeros((self.size, len(self.mesh.gain)))
        edges = self.framed(state)[2]
        step_kernel.input_columns(edges, self.unknowns_per_node, self.rod, columns)
        return self.full(columns)


def general_band_to_dense(band: Array) -> Array:
    """Return the full matrix of a general band stored by rows."""
    size, width = band.shape
    wide = np.zeros((size, size + width - 1))
    rows = np.arange(size)[:, None]
    wide[rows, rows + np.arange(width)] = band
    return wide[:, width // 2 : width // 2 + size]
