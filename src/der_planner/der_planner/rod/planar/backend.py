"""A rod in a coordinate plane, two unknowns a node."""

from __future__ import annotations

import numpy as np

from der_planner.arrays import Array
from der_planner.rod.backend import Backend, StepKernels, band_to_dense
from der_planner.rod.mesh import Mesh
from der_planner.rod.planar import elastic_kernel, step_kernel
from der_planner.rod.planar.elastic_kernel import PlanarRod, PlanarSpace
from der_planner.rod.state import RodState
from der_planner.rod.step_kernel import Base

_NO_FRAMES = Base(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))


class PlanarBackend(Backend):
    """Kernels and arrays of a planar rod; frames do not matter there and stay as they are."""

    kernels = StepKernels(step_kernel.simulate, step_kernel.newton, step_kernel.linearise)
    unknowns_per_node = 2

    def __init__(self, mesh: Mesh, plane: str) -> None:
        axis = {"xy": 1, "xz": 2}[plane]
        super().__init__(mesh, (4 * np.arange(mesh.nodes)[:, None] + np.array([0, axis])).ravel())
        first, last = self.segment_edges()
        self.rod = PlanarRod(
            rest=np.concatenate([mesh.rest[: int(mesh.ghost)], mesh.rest]),
            axial=self.ghosted(mesh.axial),
            bend=self.ghosted(mesh.bend),
            rest_kappa=self.ghosted(mesh.rest_kappa[:, axis - 1]),
            cubic=self.ghosted(mesh.cubic),
            viscous=self.ghosted(mesh.viscous),
            first=first,
            last=last,
            gain=mesh.gain if plane == "xy" else np.zeros_like(mesh.gain),
            body=self.body(),
        )

    def work_space(self, base: Base = _NO_FRAMES) -> PlanarSpace:  # noqa: ARG002 - no frames
        """Return new work arrays."""
        n = self.size // 2
        x, v, acceleration, residual, x_start, v_start = np.zeros((6, self.size))
        return PlanarSpace(
            x=x, v=v, acceleration=acceleration, residual=residual, x_start=x_start,
            v_start=v_start, s=np.zeros((self.size, 6)), a=np.zeros((self.size, 11)),
            drag=np.zeros((self.size, 11)), edge=np.zeros((n - 1, 3)), turn=np.zeros(n),
            torque=np.zeros((n, 2)), parts=np.zeros((2, 6)),
        )  # fmt: skip

    def frames(self, state: RodState) -> Base:  # noqa: ARG002 - a plane needs none
        """Return no frames."""
        return _NO_FRAMES

    def public_state(
        self,
        q: Array,
        v: Array,
        base: Base,  # noqa: ARG002 - a plane has none
        like: RodState,
    ) -> RodState:
        """Return the state at q, v with the frames of `like`."""
        return RodState(q, v, like.directors, like.reference_twist)

    def carry_frames(self, base: RodState, q: Array, v: Array) -> RodState:
        """Return a state at q with the frames of `base`."""
        return RodState(q, v, base.directors, base.reference_twist)

    def energy(self, state: RodState) -> float:
        """Return the elastic energy [J]."""
        return float(elastic_kernel.energy(self.unknowns(state.q), self.work_space(), self.rod))

    def gradient_and_hessian(self, state: RodState) -> tuple[Array, Array]:
        """Return ∇E (4N-1,) and ∇²E (4N-1, 4N-1); entries off the plane are zero."""
        gradient, still = np.zeros((2, self.size))
        u, space = np.zeros(len(self.mesh.gain)), self.work_space()
        elastic_kernel.assemble(
            self.unknowns(state.q), still, 0.0, u, False, gradient, space, self.rod
        )
        return self.full(gradient), self.full_matrix(band_to_dense(space.s))

    def input_matrix(self, state: RodState) -> Array:
        """Return B(q)Λ (4N-1, M)."""
        columns, space = np.zeros((self.size, len(self.mesh.gain))), self.work_space()
        elastic_kernel.edges_and_turns(self.unknowns(state.q), space.edge, space.turn)
        elastic_kernel.input_columns(space.edge, self.rod, columns)
        return self.full(columns)
