"""A rod in a coordinate plane, with two unknowns a node, and in space, with four."""

from __future__ import annotations

import numpy as np

from der_planner.arrays import Array
from der_planner.rod.backend import Backend, Kernels, RodState
from der_planner.rod.mesh import Mesh
from der_planner.rod.planar import elastic_kernel as planar_elastic
from der_planner.rod.planar import step_kernel as planar_step
from der_planner.rod.planar.elastic_kernel import PlanarRod, PlanarSpace
from der_planner.rod.spatial import assembly_kernel as spatial_assembly
from der_planner.rod.spatial import elastic_kernel as spatial_elastic
from der_planner.rod.spatial import step_kernel as spatial_step
from der_planner.rod.spatial.elastic_kernel import SpatialRod, SpatialSpace
from der_planner.rod.step_kernel import Base


class PlanarBackend(Backend):
    """Kernels and arrays of a planar rod; frames do not matter there and stay as they are."""

    kernels = Kernels(
        planar_step.simulate, planar_step.newton, planar_step.linearise,
        planar_elastic.energy, planar_elastic.assemble,
    )  # fmt: skip
    unknowns_per_node = 2

    def __init__(self, mesh: Mesh, plane: str) -> None:
        axis = {"xy": 1, "xz": 2}[plane]
        super().__init__(mesh, (4 * np.arange(mesh.nodes)[:, None] + np.array([0, axis])).ravel())
        self.rod = PlanarRod(
            **self.numbers(),
            rest_kappa=self.ghosted(mesh.rest_kappa[:, axis - 1]),
            gain=mesh.gain if plane == "xy" else np.zeros_like(mesh.gain),
        )

    def work_space(self, base: Base) -> PlanarSpace:  # noqa: ARG002 - no frames
        """Return new work arrays."""
        n = self.size // 2
        x, v, acceleration, residual, x_start, v_start = np.zeros((6, self.size))
        return PlanarSpace(
            x=x, v=v, acceleration=acceleration, residual=residual, x_start=x_start,
            v_start=v_start, s=np.zeros((self.size, 6)), a=np.zeros((self.size, 11)),
            drag=np.zeros((self.size, 11)), edge=np.zeros((n - 1, 3)), turn=np.zeros(n),
            torque=np.zeros((n, 2)), parts=np.zeros((2, 6)),
        )  # fmt: skip

    def framed(self, state: RodState) -> tuple[Array, PlanarSpace, Array]:
        """Return the unknowns of a state, a work space of it, and its edges."""
        x, space = self.unknowns(state.q), self.work_space(self.frames(state))
        planar_elastic.edges_and_turns(x, space.edge, space.turn)
        return x, space, space.edge


class SpatialBackend(Backend):
    """Kernels and arrays of a rod in space. With a ghost clamp one edge comes before its own."""

    kernels = Kernels(
        spatial_step.simulate, spatial_step.newton, spatial_step.linearise,
        spatial_elastic.energy, spatial_assembly.assemble,
    )  # fmt: skip
    unknowns_per_node = 4

    def __init__(self, mesh: Mesh) -> None:
        super().__init__(mesh, np.arange(4 * mesh.nodes - 1))
        self.turning_edges = mesh.nodes - 1 + int(mesh.ghost)
        self.lever = 0.1 * self.length
        self.rod = SpatialRod(
            **self.numbers(),
            twist=self.ghosted(mesh.twist),
            rest_kappa=self.ghosted(mesh.rest_kappa),
            rest_twist=self.ghosted(mesh.rest_twist),
            gain=mesh.gain,
        )

    def work_space(self, base: Base) -> SpatialSpace:
        """Return new work arrays; kernels that carry the frames change `base`."""
        n = self.turning_edges + 1
        x, v, acceleration, residual, x_start, v_start = np.zeros((6, self.size))
        a, drag, turning = np.zeros((3, self.size, 21))
        return SpatialSpace(
            base=base, x=x, v=v, acceleration=acceleration, residual=residual, x_start=x_start,
            v_start=v_start, base_start=Base(*(part.copy() for part in base)),
            s=np.zeros((self.size, 11)), a=a,
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
        spatial_step.carry(self.unknowns(q), space)
        return self.public_state(q, v, space.base, base)

    def framed(self, state: RodState) -> tuple[Array, SpatialSpace, Array]:
        """Return the unknowns of a state, a work space with its frames and twists, its edges."""
        x, space = self.unknowns(state.q), self.work_space(self.frames(state))
        spatial_elastic.frames(x, space.base, space.frame)
        spatial_elastic.reference_twists(space.frame, space.base.twists, space.twists)
        return x, space, space.frame
