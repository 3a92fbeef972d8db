"""A rod in space: between the public layout (4N-1,) and the spatial kernels (4n-1,)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.rod import banded_kernel
from der_planner.rod.backend import Piece, Place, band_to_dense, general_band_to_dense
from der_planner.rod.mesh import Mesh
from der_planner.rod.spatial import (
    assembly_kernel,
    elastic_kernel,
    linearisation_kernel,
    step_kernel,
)
from der_planner.rod.spatial.elastic_kernel import Base, SpatialRod, SpatialSpace
from der_planner.rod.state import Array, RodState
from der_planner.rod.step_kernel import Body, Record, Solver


class SpatialBackend:
    """Kernels and arrays of a rod in space; its attributes are those of `Backend`.

    With a ghost clamp one edge comes before the rod's own.
    """

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        ghost = int(mesh.ghost)
        self._ghost = ghost
        self.offset = 4 * ghost
        self.gravity = mesh.weight
        size = 4 * mesh.nodes - 1
        self.index = np.arange(size)
        held = set(mesh.clamped.tolist())
        self.fixed = np.array(
            [*range(self.offset), *(d + self.offset for d in sorted(held))], dtype=np.int64
        )
        self.free = np.array([d for d in range(size) if d not in held], dtype=np.int64)
        self.free_rows = self.free + self.offset
        self.mass = self._rate(mesh.mass_diagonal)
        self.damping = self._rate(mesh.damping_diagonal)
        one, rows = np.zeros(ghost), np.zeros((ghost, 2))
        first = [first + ghost for first, _ in mesh.segments]
        last = [first + count - 2 + ghost for first, count in mesh.segments]
        self.rod = SpatialRod(
            rest=np.concatenate([mesh.rest[:ghost], mesh.rest]),
            axial=np.concatenate([one, mesh.axial]),
            bend=np.concatenate([one, mesh.bend]),
            twist=np.concatenate([one, mesh.twist]),
            cubic=np.concatenate([one, mesh.cubic]),
            viscous=np.concatenate([one, mesh.viscous]),
            rest_kappa=np.concatenate([rows, mesh.rest_kappa]),
            rest_twist=np.concatenate([one, mesh.rest_twist]),
            first=np.array(first, dtype=np.int64),
            last=np.array(last, dtype=np.int64),
            gain=mesh.gain,
        )
        self.size = size + self.offset
        self.lever = 0.1 * float(mesh.rest.sum())

    def work_space(self) -> SpatialSpace:
        """Return new work arrays."""
        n = (self.size + 1) // 4

        def vector() -> Array:
            return np.zeros(self.size)

        return SpatialSpace(
            x=vector(), v=vector(), acceleration=vector(), residual=vector(),
            x_start=vector(), v_start=vector(),
            base_start=np.zeros((n, 7)), s=np.zeros((self.size, 11)),
            a=np.zeros((self.size, 21)), drag=np.zeros((self.size, 21)),
            frame=np.zeros((n - 1, 13)), twists=np.zeros(n), own=np.zeros((n - 1, 4, 5)),
            link=np.zeros((n, 4, 4)), local=np.zeros((12, 8)), vectors=np.zeros((10, 3)),
        )  # fmt: skip

    def place(self, state: RodState) -> Place:
        """Return a state in the kernels' coordinates, with the ghost node and its frame."""
        return Place(self._extend(state.q), self._rate(state.v), *self._base(state))

    def state(self, place: Place, like: RodState) -> RodState:  # noqa: ARG002 - space lacks nothing
        """Return the public state at a place."""
        q, v = place.x[self.offset :].copy(), place.v[self.offset :].copy()
        return self._state(q, v, Base(place.tangents, place.directors, place.twists))

    def restore(self, x: Array, base: Array) -> Array:  # noqa: ARG002 - space lacks nothing
        """Return (…, 4N-1) from kernel coordinates (…, 4n-1)."""
        return x[..., self.offset :].copy()

    def body(self, load: Array) -> Body:
        """Return what moves under a load (4N-1,)."""
        return Body(self.mass, self.damping, self._rate(load), self.fixed)

    def new_record(self, solves: int) -> Record:
        """Return an unfilled record of so many solves."""
        nodes = (self.size + 1) // 4
        return Record(
            factors=np.empty((solves, self.size, 21)),
            back=np.empty((solves, self.size, 21)),
            inputs=np.empty((solves, self.size, len(self.mesh.gain))),
            gauge=np.empty((solves, nodes - 1, 6)),
        )

    def simulate(
        self, place: Place, motion: tuple[Array, Array], pressures: Array, begin: int,
        solver: Solver, load: Array, record: Record,
    ) -> Piece:  # fmt: skip
        """Run the kernel `simulate` from step `begin` on."""
        base = Base(place.tangents, place.directors, place.twists)
        done, iterations, update, failed = step_kernel.simulate(
            *motion, place.x, place.v, base, pressures, begin, solver, record, self.work_space(),
            self.body(load), self.rod,
        )  # fmt: skip
        return Piece(done, iterations, update, failed, record)

    def linearise_equilibrium(self, state: RodState, u: Array) -> Array:
        """Return ∂q/∂u (4N-1, M) of a resting state."""
        band, columns = self._static(state, u)
        banded_kernel.factor_general(band)
        banded_kernel.solve_columns(band, columns)
        return columns[self.offset :]

    def static_stiffness(self, state: RodState, u: Array) -> Array:
        """Return −∂(F_int + B Λ u)/∂q (4N-1, 4N-1); rows of what is held are those of a unit."""
        matrix = general_band_to_dense(self._static(state, u)[0])
        return matrix[self.offset :, self.offset :]

    def _static(self, state: RodState, u: Array) -> tuple[Array, Array]:
        x = self._extend(state.q)
        space = self.work_space()
        columns, back = np.zeros((self.size, len(u))), np.zeros((self.size, 21))
        linearisation_kernel.linearise(
            x, x, 0.0, u, self._base(state), back, columns, space, self.body(0.0 * state.q),
            self.rod,
        )  # fmt: skip
        return space.a, columns

    def rows(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the kernel's rows of indices into q; -1 for indices out of range."""
        inside = (indices >= 0) & (indices < 4 * self.mesh.nodes - 1)
        return np.where(inside, indices + self.offset, -1)

    def solve_static(
        self, start: RodState, u: Array, load: Array, solver: Solver
    ) -> tuple[RodState, int, float]:
        """Solve the balance of forces from `start`; iterations are negative without convergence."""
        x = self._extend(start.q)
        base = self._base(start)
        iterations, update = step_kernel.newton(
            x, x.copy(), np.zeros(self.size), 0.0, u, solver._replace(lever=self.lever), base,
            self.work_space(), self.body(load), self.rod,
        )  # fmt: skip
        if iterations < 0:
            return start, iterations, update
        q = x[self.offset :].copy()
        return self._state(q, np.zeros_like(q), base), iterations, update

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q whose frames are those of `base`, transported."""
        frames = self._base(base)
        step_kernel.carry(self._extend(q), frames, self.work_space())
        return self._state(q, v, frames)

    def energy(self, state: RodState) -> float:
        """Return the elastic energy."""
        x, space = self._framed(state)
        return float(elastic_kernel.energy(x, space, self.rod))

    def gradient_and_hessian(self, state: RodState) -> tuple[Array, Array]:
        """Return ∇E (4N-1,) and ∇²E (4N-1, 4N-1) at a state, its frames re-based there."""
        gradient, band = self._assemble(state, np.zeros(self.size))
        return gradient, band_to_dense(band)[self.offset :, self.offset :]

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        _, space = self._framed(state)
        columns = np.zeros((self.size, len(self.mesh.gain)))
        elastic_kernel.input_columns(space.frame, self.rod, columns)
        return columns[self.offset :]

    def _extend(self, q: Array) -> Array:
        """Return the kernels' coordinates of q (4N-1,), with the ghost node."""
        if not self._ghost:
            return q.copy()
        return np.concatenate([[q[0] - self.mesh.rest[0], q[1], q[2], 0.0], q])

    def _rate(self, v: Array) -> Array:
        """Return a velocity or force (4N-1,) in the kernels' coordinates."""
        return np.concatenate([np.zeros(self.offset), v])

    def _base(self, state: RodState) -> Base:
        """Return the reference frames of a state, with the ghost edge's."""
        edges = np.diff(state.positions, axis=0)
        tangents = edges / np.linalg.norm(edges, axis=1)[:, None]
        if not self._ghost:
            return Base(tangents, state.directors.copy(), state.reference_twist.copy())
        return Base(
            np.concatenate([[[1.0, 0.0, 0.0]], tangents]),
            np.concatenate([[[0.0, 1.0, 0.0]], state.directors]),
            np.concatenate([[0.0], state.reference_twist]),
        )

    def _state(self, q: Array, v: Array, base: Base) -> RodState:
        directors, twists = base.directors[self._ghost :], base.twists[self._ghost :]
        return RodState(q, v, directors.copy(), twists.copy())

    def _framed(self, state: RodState) -> tuple[Array, SpatialSpace]:
        """Return the kernel coordinates of a state and a work space with its frames and twists."""
        x = self._extend(state.q)
        base = self._base(state)
        space = self.work_space()
        elastic_kernel.frames(x, base, space.frame)
        elastic_kernel.reference_twists(space.frame, base.twists, space.twists)
        return x, space

    def _assemble(self, state: RodState, v: Array) -> tuple[Array, Array]:
        x, space = self._framed(state)
        gradient, u = np.zeros(self.size), np.zeros(len(self.mesh.gain))
        assembly_kernel.assemble(x, v, 0.0, u, False, gradient, space, self.rod)
        return gradient[self.offset :], space.s
