"""The discrete elastic rod: construction, statics, one step, simulation, linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.rod.backend import RodState, positions_of
from der_planner.rod.dimensions import PlanarBackend, SpatialBackend
from der_planner.rod.integration import (
    Linearisation,
    Method,
    Trajectory,
    find_equilibrium,
    integrate,
    step_matrices,
)
from der_planner.rod.mesh import (
    Mesh,
    array,
    by_step,
    check_segments,
    clamped_indices,
    interleave,
    limb_mesh,
    masses_on_nodes,
    not_negative,
    positive,
    require,
)

Plane = Literal["xy", "xz"]


class Rod:
    """A rod of N nodes along x with M pressure inputs: M q̈ = F_int(q) − D q̇ + B(q) Λ u + F_ext.

    q = [x0, φ0, x1, φ1, …, φ_{N-2}, x_{N-1}] in R^(4N-1). A rod with a `plane` moves in it alone:
    its kernels carry two unknowns a node, everything public keeps the full layout.

    Attributes:
        nodes: N.
        segment_count: M.
        plane: "xy", "xz" or None (a rod in space).
        free: (F,) indices into q of the degrees of freedom that move.
        segments: ((first node, node count), …) of the M segments.
        rest_lengths: (N-1,) edge lengths at rest [m].
        input_gain: (M,) Λ, force of a unit couple per pressure [N/Pa].
        mass_diagonal: (4N-1,) M [kg, kg·m²].
        damping_diagonal: (4N-1,) D of the mass-proportional damping [kg/s, kg·m²/s].
        external_force: (4N-1,) gravity [N].
    """

    def __init__(self, mesh: Mesh, plane: Plane | None = None) -> None:
        require(plane in (None, "xy", "xz"), "plane", "'xy', 'xz' or None", plane)
        self.mesh = mesh
        self.nodes = mesh.nodes
        self.segments = mesh.segments
        self.segment_count = len(mesh.segments)
        self.plane = plane
        self.rest_lengths = mesh.rest
        self.input_gain = mesh.gain
        self.mass_diagonal = mesh.mass_diagonal
        self.damping_diagonal = mesh.damping_diagonal
        self.external_force = mesh.weight
        self._backend = PlanarBackend(mesh, plane) if plane else SpatialBackend(mesh)
        self.free = self._backend.free
        if plane:
            self._check_plane(self.external_force, "gravity")

    @classmethod
    def uniform(
        cls,
        *,
        length: float,
        nodes: int,
        EI: float,
        EA: float,
        GJ: float,
        mass_per_length: float,
        damping: float = 0.0,
        clamp: Literal["ghost", "inside", "free"] = "ghost",
        gravity: ArrayLike = (0.0, 0.0, 0.0),
        segments: Sequence[tuple[int, int]] = (),
        moment_gain: ArrayLike = (),
        plane: Plane | None = None,
        material_damping: float = 0.0,
        rest_curvature: ArrayLike = (0.0, 0.0),
        rest_twist: float = 0.0,
        fixed: Sequence[int] = (),
        masses: Sequence[tuple[float, float]] = (),
    ) -> Rod:
        """Build a straight uniform rod along x with its base at the origin.

        Args:
            length: [m].
            nodes: N, 3 or more.
            EI: bending stiffness [N·m²].
            EA: axial stiffness [N].
            GJ: torsional stiffness [N·m²].
            mass_per_length: [kg/m].
            damping: mass-proportional rate [1/s].
            clamp: "ghost" holds x0 and a ghost edge behind it, "inside" holds x0, φ0 and x1, "free"
                holds nothing.
            gravity: (3,) acceleration [m/s²].
            segments: (first node, node count) of each actuated segment.
            moment_gain: (M,) bending moment per pressure [N·m/Pa].
            plane: keep the rod in a coordinate plane with the faster planar kernels.
            material_damping: Kelvin-Voigt time τ of bending [s].
            rest_curvature: (2,) curvature toward +y and toward +z of the rod at rest [1/m].
            rest_twist: twist of the rod at rest [rad/m].
            fixed: further indices into q that do not move.
            masses: (arc length from the first node [m], mass [kg]) of each carried mass.

        Raises:
            ValueError: a value is out of range; the message says what was expected and what came.
        """
        whole = isinstance(nodes, (int, np.integer))
        require(whole and nodes >= 3, "nodes", "an int of 3 or more", nodes)
        step = positive(length, "length") / (nodes - 1)
        positive(mass_per_length, "mass_per_length")
        for value, name in ((EI, "EI"), (EA, "EA"), (GJ, "GJ")):
            positive(value, name)
        pairs = check_segments(segments, nodes)
        gain = array(moment_gain, (len(pairs),), "moment_gain")
        ghost = clamp == "ghost"
        cell = np.full(nodes, step)  # Voronoi lengths of the nodes that bend
        cell[[0, -1]] = 0.5 * step if ghost else 0.0, 0.0
        inverse = np.divide(1.0, cell, out=np.zeros(nodes), where=cell > 0)
        curvature = array(rest_curvature, (2,), "rest_curvature")
        edge_mass = np.full(nodes - 1, mass_per_length * step)
        mesh = Mesh(
            rest=np.full(nodes - 1, step),
            axial=np.full(nodes - 1, float(EA)),
            edge_mass=edge_mass,
            swung_mass=edge_mass,
            edge_inertia=edge_mass * (2.0 * EI / EA),
            edge_damping=np.full(nodes - 1, not_negative(damping, "damping")),
            bend=EI * inverse,
            twist=GJ * inverse,
            cubic=np.zeros(nodes),
            viscous=EI * not_negative(material_damping, "material_damping") * inverse,
            rest_kappa=2.0 * np.tan(0.5 * np.outer(cell, curvature)),
            rest_twist=float(rest_twist) * cell,
            gravity=array(gravity, (3,), "gravity"),
            ghost=ghost,
            clamped=clamped_indices(clamp, fixed, nodes),
            segments=pairs,
            gain=np.array(
                [g * (c - 1) / ((c - 2) * step) for g, (_, c) in zip(gain, pairs, strict=True)]
            ),
            point_mass=masses_on_nodes(masses, np.full(nodes - 1, step)),
        )
        return cls(mesh, plane)

    @classmethod
    def from_limb(
        cls,
        limb: Limb,
        nodes: int = 21,
        *,
        plane: Plane | Literal["auto"] | None = "auto",
    ) -> Rod:
        """Build the rod of a limb. "auto" is planar ("xy") unless gravity leaves the plane.

        Each segment gets edges of one length; one connector edge between two segments belongs to
        neither. A `connector_length` of zero centres a regular edge on the boundary instead. Node 0
        sits at the end of the stiff `base_length`. The limb's masses sit on the nodes; one between
        two nodes is shared by them so that its weight and its moment stay.
        """
        if plane == "auto":
            plane = "xy" if limb.gravity[2] == 0.0 else None
        return cls(limb_mesh(limb, nodes), plane)

    def warm_up(self) -> None:
        """Compile, or load from the cache, every kernel that this rod will call."""
        state = self.straight_state()
        still = np.zeros((1, self.segment_count))
        motion = self.simulate(state, still, 1e-3, linearise=True)
        if motion.linearisation is not None:
            motion.linearisation.tangent(still)
            motion.linearisation.sensitivity()
        self.linearise_step(state, still[0], 1e-3)
        self.energy(state)
        self.stiffness(state)
        self.equilibrium(still[0])

    def straight_state(self) -> RodState:
        """Return the straight, unloaded, resting state."""
        q = np.zeros(4 * self.nodes - 1)
        q[0::4] = self.mesh.base + np.append(0.0, np.cumsum(self.rest_lengths))
        directors = np.tile([0.0, 1.0, 0.0], (self.nodes - 1, 1))
        return RodState(q, np.zeros_like(q), directors, np.zeros(self.nodes))

    def state(
        self, q: ArrayLike, v: ArrayLike | None = None, *, like: RodState | None = None
    ) -> RodState:
        """Return a state at q (4N-1,), its frames transported from `like` (the straight rod)."""
        size = 4 * self.nodes - 1
        base = like or self.straight_state()
        configuration = array(q, (size,), "q")
        velocity = np.zeros(size) if v is None else array(v, (size,), "v")
        self._check_plane(configuration, "q")
        self._check_plane(velocity, "v")
        return self._backend.carry_frames(base, configuration, velocity)

    def step(
        self,
        state: RodState,
        u: ArrayLike,
        dt: float,
        method: Method = "sdirk2",
        *,
        forces: ArrayLike | None = None,
    ) -> RodState:
        """Advance by dt [s] under constant pressures u (M,) [Pa] and point forces (N, 3) [N].

        Args:
            state: where the step begins.
            u: held over the step.
            dt: length of the step.
            method: "sdirk2" (two stages, second order, damps what the step cannot resolve),
                "midpoint" (second order, one solve, keeps energy, unstable when a step turns an
                edge far while stretching is undamped) or "backward_euler" (first order, robust).
            forces: on the nodes.

        Raises:
            ConvergenceError: Newton's iteration failed.
        """
        pressures = array(u, (self.segment_count,), "u")[None]
        return self.simulate(state, pressures, dt, method=method, forces=forces, halvings=0).final

    def simulate(
        self,
        state: RodState,
        pressures: ArrayLike,
        dt: float,
        *,
        substeps: int = 1,
        method: Method = "sdirk2",
        forces: ArrayLike | None = None,
        linearise: bool = False,
        outputs: Sequence[int] | None = None,
        halvings: int = 6,
    ) -> Trajectory:
        """Run K intervals of length dt in one compiled loop, each in `substeps` equal steps.

        A step that does not converge is taken in two parts, then in four and so on: a rod that is
        stiff or fast for its step costs time. The linearisation is that of the steps as they were
        cut.

        Args:
            state: initial state.
            pressures: (K, M) held over each interval, or (K, substeps, M) one for each step [Pa].
            dt: length of an interval [s].
            substeps: S, integrator steps in an interval.
            method: as in `step`.
            forces: (N, 3) constant point forces [N].
            linearise: also keep the exact linearisation of every step: `Trajectory.linearisation`
                has `.tangent(pressure change) -> output change` and `.sensitivity(pulse=None)`
                (K+1, P, K, M), both compiled.
            outputs: (P,) indices into q of the outputs; default the tip's free coordinates.
            halvings: how often the parts of a step may be halved; 0 means never.

        Raises:
            ConvergenceError: a step did not converge, however short; with its index and the last
                good state.
        """
        inputs = by_step(pressures, substeps, self.segment_count)
        h = positive(dt, "dt") / substeps
        load = self._load(forces)
        wanted = self.output_indices(outputs) if linearise else None
        rows = None if wanted is None else self._backend.rows(wanted)
        motion, chain = integrate(self._backend, state, inputs, h, method, load, rows, halvings)
        if chain is None or wanted is None:
            return motion
        linear = Linearisation(len(inputs), substeps, wanted, chain, self._backend.free_rows)
        return replace(motion, linearisation=linear)

    def equilibrium(
        self, u: ArrayLike, *, start: RodState | None = None, forces: ArrayLike | None = None
    ) -> RodState:
        """Return the resting state under pressures u (M,) [Pa], gravity and forces (N, 3) [N].

        Raises:
            ConvergenceError: neither Newton nor load stepping found one.
        """
        pressures = array(u, (self.segment_count,), "u")
        load = self._load(forces)
        return find_equilibrium(self._backend, start or self.straight_state(), pressures, load)

    def positions(self, state: RodState | ArrayLike) -> Array:
        """Return the (N, 3) node positions [m] of a state or of q."""
        return positions_of(self._as_state(state).q)

    def tip(self, state: RodState | ArrayLike) -> Array:
        """Return the (3,) position of the last node [m]."""
        return self._as_state(state).q[-3:].copy()

    def energy(self, state: RodState | ArrayLike) -> float:
        """Return the elastic energy [J]."""
        return self._backend.energy(self._as_state(state))

    def internal_force(self, state: RodState | ArrayLike) -> Array:
        """Return the elastic force −∇E and that of Kelvin-Voigt damping (4N-1,) [N, N·m]."""
        return self._backend.internal_force(self._as_state(state))

    def stiffness(self, state: RodState | ArrayLike) -> Array:
        """Return the elastic Hessian ∇²E (4N-1, 4N-1) [N/m …]."""
        return self._backend.stiffness(self._as_state(state))

    def input_matrix(self, state: RodState | ArrayLike) -> Array:
        """Return B(q)Λ (4N-1, M) [N/Pa]: unit couples times Λ; rows of φ are zero."""
        return self._backend.input_matrix(self._as_state(state))

    def linearise_equilibrium(self, state: RodState, u: ArrayLike) -> Array:
        """Return ∂q/∂u (4N-1, M) [m/Pa] of a state that rests under u (M,) [Pa]."""
        return self._backend.linearise_equilibrium(state, array(u, (self.segment_count,), "u"))

    def smallest_stiffness(self, state: RodState, u: ArrayLike) -> float:
        """Return the smallest eigenvalue of the static stiffness of a resting state [N/m …].

        Zero or below: the rod under pressures u (M,) [Pa] does not stay there; it buckles.
        """
        matrix = self._backend.static_stiffness(state, array(u, (self.segment_count,), "u"))
        moving = matrix[np.ix_(self.free, self.free)]
        if self.plane:  # there couples have an energy, and the matrix is symmetric
            return float(np.linalg.eigvalsh(0.5 * (moving + moving.T))[0])
        return float(np.linalg.eigvals(moving).real.min())

    def linearise_step(
        self, state: RodState, u: ArrayLike, dt: float, method: Method = "sdirk2"
    ) -> tuple[Array, Array]:
        """Return the exact A (2F, 2F), B (2F, M) of δx' = A δx + B δu for one step from `state`.

        x = (q[free], v[free]); by the implicit function theorem at the converged step, with the
        derivative of B(q)u. In space φ counts from frames transported from those of `state` at the
        beginning and of the step's result at the end: what `Rod.state(q, like=…)` does.
        """
        pressures = array(u, (self.segment_count,), "u")[None, None, :]
        rows, load = self._backend.free_rows, self.external_force
        _, chain = integrate(
            self._backend, state, pressures, positive(dt, "dt"), method, load, rows
        )
        assert chain is not None  # since it was linearised
        return step_matrices(chain)

    def _load(self, forces: ArrayLike | None) -> Array:
        if forces is None:
            return self.external_force
        load = self.external_force + interleave(array(forces, (self.nodes, 3), "forces"), 0.0)
        self._check_plane(load, "forces")
        return load

    def _check_plane(self, value: Array, name: str) -> None:
        if self.plane is not None and np.delete(value, self._backend.index).any():
            raise ValueError(
                f"{name} must stay in the plane {self.plane} of this rod: for one that leaves it, "
                "build the rod with plane=None"
            )

    def _as_state(self, state: RodState | ArrayLike) -> RodState:
        return state if isinstance(state, RodState) else self.state(state)

    def output_indices(self, outputs: Sequence[int] | None) -> NDArray[np.int64]:
        """Return the indices into q (P,) of outputs; of the tip's free coordinates for None.

        Raises:
            ValueError: an index that this rod's plane does not have.
        """
        if outputs is None:
            size = 4 * self.nodes - 1
            return np.array([d for d in range(size - 3, size) if d in self.free], dtype=np.int64)
        wanted = np.asarray(outputs, dtype=np.int64)
        rows = self._backend.rows(wanted)
        require(wanted.ndim == 1 and bool((rows >= 0).all()), "outputs",
                "indices into q that this rod's plane has", outputs)  # fmt: skip
        return wanted
