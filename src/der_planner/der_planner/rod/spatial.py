"""A rod in space: between the public layout (4N-1,) and the spatial kernels (4n-1,)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from der_planner.rod import spatial_assembly_kernel, spatial_kernel, spatial_step_kernel
from der_planner.rod.backend import Run, Solves, band_to_dense
from der_planner.rod.mesh import Mesh
from der_planner.rod.spatial_linearisation import Stage, propagate, residual_derivatives
from der_planner.rod.state import Array, Arrays, RodState


class SpatialBackend:
    """Kernels and arrays of a rod in space; a ghost edge comes before the rod's own."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.ghost = int(mesh.ghost)
        self.offset = 4 * self.ghost
        size = 4 * mesh.nodes - 1
        self.index = np.arange(size)
        held = set(mesh.clamped.tolist())
        self.fixed = np.array(
            [*range(self.offset), *(d + self.offset for d in sorted(held))], dtype=np.int64
        )
        self.free = np.array([d for d in range(size) if d not in held], dtype=np.int64)
        self.free_rows = self.free + self.offset
        self.mass = self.extend_rate(mesh.mass_diagonal)
        self.damping = self.extend_rate(mesh.damping_diagonal)
        one, rows = np.zeros(self.ghost), np.zeros((self.ghost, 2))
        first = [first + self.ghost for first, _ in mesh.segments]
        last = [first + count - 2 + self.ghost for first, count in mesh.segments]
        self.rod: Arrays = (
            np.concatenate([mesh.rest[: self.ghost], mesh.rest]),
            np.concatenate([one, mesh.axial]),
            np.concatenate([one, mesh.bend]),
            np.concatenate([one, mesh.twist]),
            np.concatenate([one, mesh.cubic]),
            np.concatenate([one, mesh.viscous]),
            np.concatenate([rows, mesh.rest_kappa]),
            np.concatenate([one, mesh.rest_twist]),
            np.array(first, dtype=np.int64),
            np.array(last, dtype=np.int64),
            mesh.gain,
        )
        n = mesh.nodes + self.ghost
        self.size = 4 * n - 1
        self.lever = 0.1 * float(mesh.rest.sum())

    def work_space(self) -> Arrays:
        """Return new work arrays: twists, work, s, frame, own, link, local, vectors, a."""
        n = (self.size + 1) // 4
        return (
            np.zeros(n),
            np.zeros((6, self.size)),
            np.zeros((self.size, 11)),
            np.zeros((n - 1, 13)),
            np.zeros((n - 1, 4, 5)),
            np.zeros((n, 4, 4)),
            np.zeros((12, 8)),
            np.zeros((10, 3)),
            np.zeros((self.size, 21)),
        )

    def extend(self, q: Array) -> Array:
        """Return the kernels' coordinates of q, with the ghost node."""
        if not self.ghost:
            return q.copy()
        return np.concatenate([[q[0] - self.mesh.rest[0], q[1], q[2], 0.0], q])

    def extend_rate(self, v: Array) -> Array:
        """Return a velocity or force (4N-1,) in the kernels' coordinates."""
        return np.concatenate([np.zeros(self.offset), v])

    def reference(self, state: RodState) -> Arrays:
        """Return tangents, directors (n-1, 3) and reference twists (n,) for the kernels."""
        x = state.q
        nodes = np.stack([x[0::4], x[1::4], x[2::4]], axis=1)
        edges = np.diff(nodes, axis=0)
        tangents = edges / np.linalg.norm(edges, axis=1)[:, None]
        if not self.ghost:
            return tangents, state.directors.copy(), state.reference_twist.copy()
        return (
            np.concatenate([[[1.0, 0.0, 0.0]], tangents]),
            np.concatenate([[[0.0, 1.0, 0.0]], state.directors]),
            np.concatenate([[0.0], state.reference_twist]),
        )

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q whose frames are those of `base`, transported."""
        frames = self.reference(base)
        spatial_step_kernel.carry(self.extend(q), frames, self.work_space())
        return self._state(q, v, frames)

    def _state(self, q: Array, v: Array, base: Arrays) -> RodState:
        _, directors, twists = base
        return RodState(q, v, directors[self.ghost :].copy(), twists[self.ghost :].copy())

    def _body(self, load: Array) -> Arrays:
        return self.mass, self.damping, self.extend_rate(load), self.fixed

    def simulate(
        self, state: RodState, pressures: Array, solves: Solves, linearise: bool = False
    ) -> Run:
        """Run the kernel `simulate` under pressures (K, S, M)."""
        if linearise:
            raise ValueError(
                "a rod in space keeps no linearisation of a motion: use linearise_step"
            )
        intervals, steps, _ = pressures.shape
        x = np.empty((intervals + 1, self.size))
        rate = np.empty((intervals + 1, self.size))
        x[0] = self.extend(state.q)
        rate[0] = self.extend_rate(state.v)
        base = self.reference(state)
        done, iterations, update, failed = spatial_step_kernel.simulate(
            x, rate, pressures, solves.h, solves.extrapolate, solves.tolerance, self.lever,
            solves.limit, base, self.work_space(), self._body(solves.load), self.rod,
        )  # fmt: skip
        q = x[:, self.offset :].copy()
        v = rate[:, self.offset :].copy()
        at = done // steps + 1 if failed else intervals
        final = self._state(q[at].copy(), v[at].copy(), base)
        return Run(q, v, final, done, iterations, update, failed, None)

    def linearise(
        self, state: RodState, u: Array, solves: Solves
    ) -> tuple[Run, tuple[Array, Array] | None]:
        """Return the run and (A, B) of one step; no matrices if a stage failed."""
        count, inputs = len(self.free), len(u)
        dq = np.zeros((self.size, 2 * count + inputs))
        dv = np.zeros_like(dq)
        dq[self.free_rows, np.arange(count)] = 1.0
        dv[self.free_rows, np.arange(count, 2 * count)] = 1.0
        once = replace(solves, extrapolate=np.ones(1))
        for e in solves.extrapolate:
            run = self.simulate(state, u[None, None, :], once)
            if run.failed_iterations:
                return run, None
            x_n, x = self.extend(state.q), self.extend(run.final.q)
            stage = Stage(x, x_n, 1.0 / solves.h, u, *self.reference(state))
            derivatives = residual_derivatives(stage, self.rod, self.work_space())
            dq, dv = propagate(
                stage, derivatives, self.mass, self.damping, self.free_rows, e, (dq, dv)
            )
            q = state.q + e * (run.final.q - state.q)
            v = state.v + e * (run.final.v - state.v)
            state = self.carry_frames(state, q, v)
        both = np.concatenate([dq[self.free_rows], dv[self.free_rows]])
        return run, (both[:, : 2 * count], both[:, 2 * count :])

    def linearise_equilibrium(self, state: RodState, u: Array) -> Array:
        """Return ∂q/∂u (4N-1, M) of a resting state."""
        x = self.extend(state.q)
        stage = Stage(x, x, 0.0, u, *self.reference(state))
        by_x, _, columns = residual_derivatives(stage, self.rod, self.work_space())
        rows = self.free_rows
        result = np.zeros((4 * self.mesh.nodes - 1, len(u)))
        result[self.free] = np.linalg.solve(by_x[np.ix_(rows, rows)], columns[rows])
        return result

    def rows(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the kernel's rows of indices into q; -1 for indices out of range."""
        inside = (indices >= 0) & (indices < 4 * self.mesh.nodes - 1)
        return np.where(inside, indices + self.offset, -1)

    def solve_static(
        self, start: RodState, u: Array, load: Array, tolerance: float, limit: int
    ) -> tuple[RodState, int, float]:
        """Solve the balance of forces from `start`; iterations are negative without convergence."""
        x = self.extend(start.q)
        base = self.reference(start)
        iterations, update = spatial_step_kernel.newton(
            x, x.copy(), np.zeros(self.size), 0.0, u, tolerance, self.lever, limit, base,
            self.work_space(), self._body(load), self.rod,
        )  # fmt: skip
        if iterations < 0:
            return start, iterations, update
        q = x[self.offset :].copy()
        return self._state(q, np.zeros_like(q), base), iterations, update

    def _place(self, state: RodState) -> tuple[Array, Arrays]:
        """Return the kernel coordinates of a state and a work space with its frames and twists."""
        x = self.extend(state.q)
        tangents, directors, twists = self.reference(state)
        space = self.work_space()
        spatial_kernel.frames(x, tangents, directors, space[3])
        spatial_kernel.reference_twists(space[3], twists, space[0])
        return x, space

    def energy(self, state: RodState) -> float:
        """Return the elastic energy."""
        x, (twists, _, _, frame, _, _, local, _, _) = self._place(state)
        return float(spatial_kernel.energy(x, frame, twists, local, self.rod))

    def _assemble(self, state: RodState, v: Array) -> tuple[Array, Array]:
        x, (twists, _, s, frame, own, link, local, vectors, _) = self._place(state)
        gradient = np.zeros(self.size)
        spatial_assembly_kernel.assemble(
            x, v, 0.0, np.zeros(len(self.mesh.gain)), False, gradient, s, frame, twists, own, link,
            local, vectors, self.rod,
        )  # fmt: skip
        return gradient[self.offset :], s

    def gradient_and_hessian(self, state: RodState) -> tuple[Array, Array]:
        """Return ∇E (4N-1,) and ∇²E (4N-1, 4N-1) at a state, its frames re-based there."""
        gradient, band = self._assemble(state, np.zeros(self.size))
        return gradient, band_to_dense(band)[self.offset :, self.offset :]

    def viscous_force(self, state: RodState) -> Array:
        """Return the Kelvin-Voigt force (4N-1,) at a state."""
        moving, _ = self._assemble(state, self.extend_rate(state.v))
        still, _ = self._assemble(state, np.zeros(self.size))
        return still - moving

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        _, space = self._place(state)
        columns = np.zeros((self.size, len(self.mesh.gain)))
        spatial_kernel.input_columns(space[3], self.rod, columns)
        return columns[self.offset :]
