"""A rod in a coordinate plane: between the public layout (4N-1,) and the planar kernels (2n,)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.rod import banded_kernel
from der_planner.rod.backend import Piece, Place, band_to_dense, general_band_to_dense
from der_planner.rod.mesh import Mesh
from der_planner.rod.planar import elastic_kernel, step_kernel
from der_planner.rod.planar.elastic_kernel import PlanarRod, PlanarSpace
from der_planner.rod.state import Array, RodState
from der_planner.rod.step_kernel import Body, Record, Solver


class PlanarBackend:
    """Kernels and arrays of a planar rod; its attributes are those of `Backend`."""

    def __init__(self, mesh: Mesh, plane: str) -> None:
        self.mesh = mesh
        axis = {"xy": 1, "xz": 2}[plane]
        nodes = mesh.nodes
        ghost = int(mesh.ghost)
        self.offset = 2 * ghost
        self.gravity = mesh.weight
        self.lever = 0.0
        self.index = (4 * np.arange(nodes)[:, None] + np.array([0, axis])).ravel()
        held = set(mesh.clamped.tolist())
        fixed = [k + self.offset for k, d in enumerate(self.index) if d in held]
        self.fixed = np.array([*range(self.offset), *fixed], dtype=np.int64)
        self.free = np.array([d for d in self.index if d not in held], dtype=np.int64)
        self.free_rows = self.rows(self.free)
        self.mass = np.concatenate([np.zeros(self.offset), np.repeat(mesh.swung_node_mass, 2)])
        self.damping = np.concatenate([np.zeros(self.offset), np.repeat(mesh.node_damping, 2)])
        first = [first + ghost for first, _ in mesh.segments]
        last = [first + count - 2 + ghost for first, count in mesh.segments]
        one = np.zeros(ghost)
        self.rod = PlanarRod(
            rest=np.concatenate([mesh.rest[:ghost], mesh.rest]),
            axial=np.concatenate([one, mesh.axial]),
            bend=np.concatenate([one, mesh.bend]),
            rest_kappa=np.concatenate([one, np.ascontiguousarray(mesh.rest_kappa[:, axis - 1])]),
            cubic=np.concatenate([one, mesh.cubic]),
            viscous=np.concatenate([one, mesh.viscous]),
            first=np.array(first, dtype=np.int64),
            last=np.array(last, dtype=np.int64),
            gain=mesh.gain if plane == "xy" else np.zeros_like(mesh.gain),
        )
        self.size = 2 * (nodes + ghost)

    def work_space(self) -> PlanarSpace:
        """Return new work arrays."""
        n = self.size // 2

        def vector() -> Array:
            return np.zeros(self.size)

        return PlanarSpace(
            x=vector(), v=vector(), acceleration=vector(), residual=vector(),
            x_start=vector(), v_start=vector(),
            s=np.zeros((self.size, 6)), a=np.zeros((self.size, 11)),
            drag=np.zeros((self.size, 11)), edge=np.zeros((n - 1, 3)), turn=np.zeros(n),
            torque=np.zeros((n, 2)), parts=np.zeros((2, 6)),
        )  # fmt: skip

    def place(self, state: RodState) -> Place:
        """Return a state in the kernels' coordinates, with the ghost node."""
        none = np.zeros((0, 3))
        return Place(self._extend(state.q), self._rate(state.v), none, none, np.zeros(0))

    def state(self, place: Place, like: RodState) -> RodState:
        """Return the public state at a place; the frames of a planar rod do not matter and stay."""
        q, v = self.restore(place.x, like.q), self.restore(place.v, like.v)
        return RodState(q, v, like.directors, like.reference_twist)

    def restore(self, x: Array, base: Array) -> Array:
        """Return copies of base (4N-1,) with the planar coordinates of x (…, 2n)."""
        result = np.broadcast_to(base, (*x.shape[:-1], base.shape[0])).copy()
        result[..., self.index] = x[..., self.offset :]
        return result

    def body(self, load: Array) -> Body:
        """Return what moves under a load (4N-1,)."""
        return Body(self.mass, self.damping, self._rate(load), self.fixed)

    def new_record(self, solves: int) -> Record:
        """Return an unfilled record of so many solves."""
        back = solves if self.mesh.viscous.any() else 0
        return Record(
            factors=np.empty((solves, self.size, 11)),
            back=np.empty((back, self.size, 11)),
            inputs=np.empty((solves, self.size, len(self.mesh.gain))),
            gauge=np.empty((0, 0, 6)),
        )

    def simulate(
        self, place: Place, motion: tuple[Array, Array], pressures: Array, begin: int,
        solver: Solver, load: Array, record: Record,
    ) -> Piece:  # fmt: skip
        """Run the kernel `simulate` from step `begin` on."""
        done, iterations, update, failed = step_kernel.simulate(
            *motion, place.x, place.v, pressures, begin, solver, record, self.work_space(),
            self.body(load), self.rod,
        )  # fmt: skip
        return Piece(done, iterations, update, failed, record)

    def linearise_equilibrium(self, state: RodState, u: Array) -> Array:
        """Return ∂q/∂u (4N-1, M) of a resting state."""
        band, columns = self._static(state, u)
        banded_kernel.factor_general(band)
        banded_kernel.solve_columns(band, columns)
        return self._full(columns)

    def static_stiffness(self, state: RodState, u: Array) -> Array:
        """Return −∂(F_int + B Λ u)/∂q (4N-1, 4N-1); rows of what is held are those of a unit."""
        return self._full_matrix(general_band_to_dense(self._static(state, u)[0]))

    def _static(self, state: RodState, u: Array) -> tuple[Array, Array]:
        x = self._extend(state.q)
        space = self.work_space()
        columns = np.zeros((self.size, len(u)))
        step_kernel.linearise(x, x, 0.0, u, columns, space, self.body(0.0 * state.q), self.rod)
        return space.a, columns

    def rows(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the kernel's rows of indices into q; -1 for what the plane does not have."""
        lookup = {int(d): k + self.offset for k, d in enumerate(self.index)}
        return np.array([lookup.get(int(d), -1) for d in indices], dtype=np.int64)

    def solve_static(
        self, start: RodState, u: Array, load: Array, solver: Solver
    ) -> tuple[RodState, int, float]:
        """Solve the balance of forces from `start`; iterations are negative without convergence."""
        x = self._extend(start.q)
        iterations, update = step_kernel.newton(
            x, x.copy(), np.zeros(self.size), 0.0, u, solver, self.work_space(), self.body(load),
            self.rod,
        )  # fmt: skip
        q = self.restore(x, start.q)
        return RodState(q, 0.0 * q, start.directors, start.reference_twist), iterations, update

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q; the frames of a planar rod do not matter and stay."""
        return RodState(q, v, base.directors, base.reference_twist)

    def energy(self, state: RodState) -> float:
        """Return the elastic energy."""
        return float(elastic_kernel.energy(self._extend(state.q), self.work_space(), self.rod))

    def gradient_and_hessian(self, state: RodState) -> tuple[Array, Array]:
        """Return ∇E (4N-1,) and ∇²E (4N-1, 4N-1); entries off the plane are zero."""
        gradient = np.zeros(self.size)
        still, u = np.zeros(self.size), np.zeros(len(self.mesh.gain))
        space = self.work_space()
        x = self._extend(state.q)
        elastic_kernel.assemble(x, still, 0.0, u, False, gradient, space, self.rod)
        return self._full(gradient), self._full_matrix(band_to_dense(space.s))

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        columns = np.zeros((self.size, len(self.mesh.gain)))
        space = self.work_space()
        elastic_kernel.edges_and_turns(self._extend(state.q), space.edge, space.turn)
        elastic_kernel.input_columns(space.edge, self.rod, columns)
        return self._full(columns)

    def _extend(self, q: Array) -> Array:
        """Return the kernels' coordinates of q (4N-1,), with the ghost node."""
        planar: Array = q[self.index]
        if not self.offset:
            return planar
        return np.concatenate([[planar[0] - self.mesh.rest[0], planar[1]], planar])

    def _rate(self, v: Array) -> Array:
        """Return a velocity or force (4N-1,) in the kernels' coordinates."""
        return np.concatenate([np.zeros(self.offset), v[self.index]])

    def _full(self, planar: Array) -> Array:
        result = np.zeros((4 * self.mesh.nodes - 1, *planar.shape[1:]))
        result[self.index] = planar[self.offset :]
        return result

    def _full_matrix(self, planar: Array) -> Array:
        size = 4 * self.mesh.nodes - 1
        result = np.zeros((size, size))
        inner = planar[self.offset :, self.offset :]
        result[np.ix_(self.index, self.index)] = inner
        return result
