"""A rod in a coordinate plane: between the public layout (4N-1,) and the planar kernels (2n,)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.rod import band_kernel, planar_kernel, planar_step_kernel
from der_planner.rod.backend import Run, Solves, band_to_dense
from der_planner.rod.linearisation import StageStates, StepFactors, step_matrices
from der_planner.rod.mesh import Mesh
from der_planner.rod.state import Array, Arrays, RodState


class PlanarBackend:
    """Kernels and arrays of a planar rod."""

    def __init__(self, mesh: Mesh, plane: str) -> None:
        self.mesh = mesh
        axis = {"xy": 1, "xz": 2}[plane]
        nodes = mesh.nodes
        self.ghost = int(mesh.ghost)
        self.gravity = mesh.weight
        self.index = (4 * np.arange(nodes)[:, None] + np.array([0, axis])).ravel()
        held = set(mesh.clamped.tolist())
        fixed = [k for k, d in enumerate(self.index) if d in held]
        self.fixed = np.array(
            [*range(2 * self.ghost), *(k + 2 * self.ghost for k in fixed)], dtype=np.int64
        )
        self.free = np.array([d for d in self.index if d not in held], dtype=np.int64)
        self.free_rows = np.array(
            [k + 2 * self.ghost for k, d in enumerate(self.index) if d not in held], dtype=np.int64
        )
        mass = np.repeat(mesh.node_mass, 2)
        damping = np.repeat(mesh.node_damping, 2)
        pad = np.zeros(2 * self.ghost)
        self.mass = np.concatenate([pad, mass])
        self.damping = np.concatenate([pad, damping])
        first = np.array([first + self.ghost for first, _ in mesh.segments], dtype=np.int64)
        last = np.array(
            [first + count - 2 + self.ghost for first, count in mesh.segments], dtype=np.int64
        )
        one = np.zeros(self.ghost)
        actuated = plane == "xy"
        self.rod: Arrays = (
            np.concatenate([mesh.rest[: self.ghost], mesh.rest]),
            np.concatenate([one, mesh.axial]),
            np.concatenate([one, mesh.bend]),
            np.concatenate([one, np.ascontiguousarray(mesh.rest_kappa[:, axis - 1])]),
            np.concatenate([one, mesh.cubic]),
            np.concatenate([one, mesh.viscous]),
            first,
            last,
            mesh.gain if actuated else np.zeros_like(mesh.gain),
        )
        n = nodes + self.ghost
        self.size = 2 * n

    def work_space(self) -> Arrays:
        """Return new work arrays: work, s, band, edge, turn, torque, parts, a."""
        n = self.size // 2
        return (
            np.zeros((6, self.size)),
            np.zeros((self.size, 6)),
            np.zeros((self.size, 6)),
            np.zeros((n - 1, 3)),
            np.zeros(n),
            np.zeros((n, 2)),
            np.zeros((2, 6)),
            np.zeros((self.size, 11)),
        )

    def extend(self, q: Array) -> Array:
        """Return the kernels' coordinates of q, with the ghost node."""
        planar: Array = q[self.index]
        if not self.ghost:
            return planar
        return np.concatenate([[planar[0] - self.mesh.rest[0], planar[1]], planar])

    def extend_rate(self, v: Array) -> Array:
        """Return a velocity or force (4N-1,) in the kernels' coordinates."""
        return np.concatenate([np.zeros(2 * self.ghost), v[self.index]])

    def _body(self, load: Array) -> Arrays:
        return self.mass, self.damping, self.extend_rate(load), self.fixed

    def restore(self, x: Array, base: Array) -> Array:
        """Return copies of base (4N-1,) with the planar coordinates of x (…, 2n)."""
        result = np.broadcast_to(base, (*x.shape[:-1], base.shape[0])).copy()
        result[..., self.index] = x[..., 2 * self.ghost :]
        return result

    def simulate(
        self, state: RodState, pressures: Array, solves: Solves, linearise: bool = False
    ) -> Run:
        """Run the kernel `simulate` under pressures (K, S, M)."""
        intervals, steps, inputs = pressures.shape
        kept = intervals * steps if linearise else 0
        viscous = kept if self.mesh.viscous.any() else 0
        factors = np.empty((kept, self.size, 11))
        bands = np.empty((viscous, self.size, 6))
        columns = np.empty((kept, self.size, inputs))
        stages = np.empty((kept, 3, self.size))
        x = np.empty((intervals + 1, self.size))
        rate = np.empty((intervals + 1, self.size))
        x[0] = self.extend(state.q)
        rate[0] = self.extend_rate(state.v)
        done, iterations, update, failed = planar_step_kernel.simulate(
            x, rate, pressures, solves.h, solves.extrapolate, solves.tolerance, solves.limit,
            factors, bands, columns, stages, self.work_space(), self._body(solves.load), self.rod,
        )  # fmt: skip
        q = self.restore(x, state.q)
        v = self.restore(rate, state.v)
        at = done // steps + 1 if failed else intervals
        final = RodState(q[at].copy(), v[at].copy(), state.directors, state.reference_twist)
        stored = motion = None
        if linearise and not failed:
            stored = StepFactors(
                factors, bands, columns, *self._diagonals(solves.h), 1.0 / solves.h,
                solves.extrapolate,
            )  # fmt: skip
            motion = StageStates(stages, pressures.reshape(kept, inputs), solves.load)
        return Run(q, v, final, done, iterations, update, failed, stored, motion)

    def linearise(
        self, state: RodState, u: Array, solves: Solves
    ) -> tuple[Run, tuple[Array, Array] | None]:
        """Return the run and (A, B) of one step; no matrices if a stage failed."""
        pressures = np.ascontiguousarray(np.broadcast_to(u, (1, len(solves.extrapolate), len(u))))
        run = self.simulate(state, pressures, solves, linearise=True)
        if run.factors is None:
            return run, None
        return run, step_matrices(run.factors, self.free_rows)

    def residual_changes(self, other: PlanarBackend, motion: StageStates, rate: float) -> Array:
        """Return (steps, n) what a change to the other rod adds to the right sides of the steps."""
        out = np.empty((len(motion.states), self.size))
        load = motion.load + other.gravity - self.gravity
        planar_step_kernel.residual_changes(
            motion.states, motion.pressures, rate, self.work_space(), self._body(motion.load),
            self.rod, other._body(load), other.rod, out,
        )  # fmt: skip
        return out

    def linearise_equilibrium(self, state: RodState, u: Array) -> Array:
        """Return ∂q/∂u (4N-1, M) of a resting state."""
        x = self.extend(state.q)
        a = np.zeros((self.size, 11))
        columns = np.zeros((self.size, len(u)))
        planar_step_kernel.linearise(
            x, x, 0.0, u, a, columns, self.work_space(), self._body(0.0 * state.q), self.rod
        )
        band_kernel.factor_general(a)
        band_kernel.solve_columns(a, columns)
        return self._full(columns)

    def _diagonals(self, h: float) -> tuple[Array, Array]:
        inertia = (self.mass / h + self.damping) / h
        momentum = self.mass / h
        inertia[self.fixed] = 0.0
        momentum[self.fixed] = 0.0
        return inertia, momentum

    def rows(self, indices: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the kernel's rows of indices into q; -1 for what the plane does not have."""
        lookup = {int(d): k + 2 * self.ghost for k, d in enumerate(self.index)}
        return np.array([lookup.get(int(d), -1) for d in indices], dtype=np.int64)

    def solve_static(
        self, start: RodState, u: Array, load: Array, tolerance: float, limit: int
    ) -> tuple[RodState, int, float]:
        """Solve the balance of forces from `start`; iterations are negative without convergence."""
        x = self.extend(start.q)
        iterations, update = planar_step_kernel.newton(
            x, x.copy(), np.zeros(self.size), 0.0, u, tolerance, limit,
            self.work_space(), self._body(load), self.rod,
        )  # fmt: skip
        q = self.restore(x, start.q)
        return RodState(q, 0.0 * q, start.directors, start.reference_twist), iterations, update

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q; the frames of a planar rod do not matter and stay."""
        return RodState(q, v, base.directors, base.reference_twist)

    def energy(self, state: RodState) -> float:
        """Return the elastic energy."""
        _, _, _, edge, turn, _, _, _ = self.work_space()
        return float(planar_kernel.energy(self.extend(state.q), edge, turn, self.rod))

    def gradient_and_hessian(self, state: RodState) -> tuple[Array, Array]:
        """Return ∇E (4N-1,) and ∇²E (4N-1, 4N-1); entries off the plane are zero."""
        x = self.extend(state.q)
        gradient = np.zeros(self.size)
        u = np.zeros(len(self.mesh.gain))
        _, s, _, edge, turn, torque, _, _ = self.work_space()
        planar_kernel.assemble(
            x, np.zeros(self.size), 0.0, u, False, gradient, s, edge, turn, torque, self.rod
        )
        return self._full(gradient), self._full_matrix(band_to_dense(s))

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        columns = np.zeros((self.size, len(self.mesh.gain)))
        _, _, _, edge, turn, _, _, _ = self.work_space()
        planar_kernel.edges_and_turns(self.extend(state.q), edge, turn)
        planar_kernel.input_columns(edge, self.rod, columns)
        return self._full(columns)

    def viscous_force(self, state: RodState) -> Array:
        """Return the Kelvin-Voigt force (4N-1,) at a state."""
        x, v = self.extend(state.q), self.extend_rate(state.v)
        a = np.zeros((self.size, 11))
        _, _, band, edge, turn, _, parts, _ = self.work_space()
        u = np.zeros(len(self.mesh.gain))
        planar_kernel.edges_and_turns(x, edge, turn)
        planar_kernel.unsymmetric(v, 1.0, u, a, band, edge, turn, parts, self.rod)
        return self._full(-band_to_dense(band) @ v)

    def _full(self, planar: Array) -> Array:
        result = np.zeros((4 * self.mesh.nodes - 1, *planar.shape[1:]))
        result[self.index] = planar[2 * self.ghost :]
        return result

    def _full_matrix(self, planar: Array) -> Array:
        size = 4 * self.mesh.nodes - 1
        result = np.zeros((size, size))
        inner = planar[2 * self.ghost :, 2 * self.ghost :]
        result[np.ix_(self.index, self.index)] = inner
        return result
