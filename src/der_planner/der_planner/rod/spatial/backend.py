"""A rod in space, four unknowns a node."""

from __future__ import annotations

import numpy as np

from der_planner.arrays import Array
from der_planner.rod.backend import Backend, StepKernels, band_to_dense
from der_planner.rod.mesh import Mesh
from der_planner.rod.spatial import assembly_kernel, elastic_kernel, step_kernel
from der_planner.rod.spatial.elastic_kernel import SpatialRod, SpatialSpace
from der_planner.rod.state import RodState
from der_planner.rod.step_kernel import Base


class SpatialBackend(Backend):
    """Kernels and arrays of a rod in space. With a ghost clamp one edge comes before its own."""

    kernels = StepKernels(step_kernel.simulate, step_kernel.newton, step_kernel.linearise)
    unknowns_per_node = 4

    def __init__(self, mesh: Mesh) -> None:
        super().__init__(mesh, np.arange(4 * mesh.nodes - 1))
        self.turning_edges = mesh.nodes - 1 + int(mesh.ghost)
        self.lever = 0.1 * float(mesh.rest.sum())
        first, last = self.segment_edges()
        self.rod = SpatialRod(
            rest=np.concatenate([mesh.rest[: int(mesh.ghost)], mesh.rest]),
            axial=self.ghosted(mesh.axial),
            bend=self.ghosted(mesh.bend),
            twist=self.ghosted(mesh.twist),
            cubic=self.ghosted(mesh.cubic),
            viscous=self.ghosted(mesh.viscous),
            rest_kappa=self.ghosted(mesh.rest_kappa),
            rest_twist=self.ghosted(mesh.rest_twist),
            first=first,
            last=last,
            gain=mesh.gain,
            body=self.body(),
        )

    def work_space(self, base: Base) -> SpatialSpace:
        """Return new work arrays; kernels that carry the frames change `base`."""
        n = self.turning_edges + 1
        x, v, acceleration, residual, x_start, v_start = np.zeros((6, self.size))
        a, drag, turning = np.zeros((3, self.size, 21))
        return SpatialSpace(
            base=base, x=x, v=v, acceleration=acceleration, residual=residual, x_start=x_start,
            v_start=v_start, base_start=np.zeros((n, 7)), s=np.zeros((self.size, 11)), a=a,
            drag=drag, turning=turning, frame=np.zeros((n - 1, 13)), twists=np.zeros(n),
            own=np.zeros((n - 1, 4, 5)), link=np.zeros((n, 4, 4)), local=np.zeros((12, 8)),
            vectors=np.zeros((10, 3)),
        )  # fmt: skip

    def frames(self, state: RodState) -> Base:
        """Return copies of the reference frames of a state, with the ghost edge's."""
        edges = np.diff(state.positions, axis=0)
        tangents = edges / np.linalg.norm(edges, axis=1)[:, None]
        ghost = int(self.mesh.ghost)
        return Base(
            np.concatenate([np.tile([1.0, 0.0, 0.0], (ghost, 1)), tangents]),
            np.concatenate([np.tile([0.0, 1.0, 0.0], (ghost, 1)), state.directors]),
            self.ghosted(state.reference_twist),
        )

    def public_state(
        self,
        q: Array,
        v: Array,
        base: Base,
        like: RodState,  # noqa: ARG002 - space lacks nothing
    ) -> RodState:
        """Return the state at q, v with copies of these frames."""
        ghost = int(self.mesh.ghost)
        return RodState(q, v, base.directors[ghost:].copy(), base.twists[ghost:].copy())

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q whose frames are those of `base`, transported."""
        space = self.work_space(self.frames(base))
        step_kernel.carry(self.unknowns(q), space)
        return self.public_state(q, v, space.base, base)

    def energy(self, state: RodState) -> float:
        """Return the elastic energy [J]."""
        return float(elastic_kernel.energy(*self._framed(state), self.rod))

    def gradient_and_hessian(self, state: RodState) -> tuple[Array, Array]:
        """Return ∇E (4N-1,) and ∇²E (4N-1, 4N-1) at a state, its frames re-based there."""
        x, space = self._framed(state)
        gradient, still = np.zeros((2, self.size))
        u = np.zeros(len(self.mesh.gain))
        assembly_kernel.assemble(x, still, 0.0, u, False, gradient, space, self.rod)
        return self.full(gradient), self.full_matrix(band_to_dense(space.s))

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        columns = np.zeros((self.size, len(self.mesh.gain)))
        elastic_kernel.input_columns(self._framed(state)[1].frame, self.rod, columns)
        return self.full(columns)

    def _framed(self, state: RodState) -> tuple[Array, SpatialSpace]:
        """Return the unknowns of a state and a work space with its frames and twists."""
        x, space = self.unknowns(state.q), self.work_space(self.frames(state))
        elastic_kernel.frames(x, space.base, space.frame)
        elastic_kernel.reference_twists(space.frame, space.base.twists, space.twists)
        return x, space
