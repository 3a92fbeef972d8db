"""The discrete elastic rod: construction, statics, one step, simulation, linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from der_planner.limb import Limb
from der_planner.rod.state import Array, RodState, Trajectory

Method = Literal["midpoint", "backward_euler"]
Plane = Literal["xy", "xz"]


class Rod:
    """A rod of N nodes along x with M pressure inputs: M q̈ = F_int(q) − D q̇ + B(q) Λ u + F_ext.

    q = [x0, φ0, x1, φ1, …, φ_{N-2}, x_{N-1}] in R^(4N-1). A rod with a `plane` moves in it alone: its
    kernels carry two unknowns a node, everything public keeps the full layout.

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
            clamp: "ghost" holds x0 and a ghost edge behind it, "inside" holds x0, φ0 and x1, "free" holds
                nothing.
            gravity: (3,) acceleration [m/s²].
            segments: (first node, node count) of each actuated segment.
            moment_gain: (M,) bending moment per pressure [N·m/Pa].
            plane: keep the rod in a coordinate plane with the faster planar kernels.
            material_damping: Kelvin-Voigt time τ of bending [s].
            rest_curvature: (2,) curvature toward +y and toward +z of the rod at rest [1/m].
            rest_twist: twist of the rod at rest [rad/m].
            fixed: further indices into q that do not move.

        Raises:
            ValueError: a value is out of range; the message says what was expected and what came.
        """
        raise NotImplementedError

    @classmethod
    def from_limb(
        cls,
        limb: Limb,
        nodes: int = 21,
        *,
        clamp: Literal["ghost", "inside"] = "ghost",
        plane: Plane | Literal["auto"] | None = "auto",
    ) -> Rod:
        """Build the rod of a limb. "auto" is planar ("xy") unless gravity leaves the plane.

        Each segment gets edges of one length; one connector edge between two segments belongs to
        neither. A `connector_length` of zero centres a regular edge on the boundary instead.
        """
        raise NotImplementedError

    def straight_state(self) -> RodState:
        """Return the straight, unloaded, resting state."""
        raise NotImplementedError

    def state(
        self, q: ArrayLike, v: ArrayLike | None = None, *, like: RodState | None = None
    ) -> RodState:
        """Return a state at q (4N-1,), its frames transported from `like` (the straight rod)."""
        raise NotImplementedError

    def step(
        self,
        state: RodState,
        u: ArrayLike,
        dt: float,
        method: Method = "midpoint",
        *,
        forces: ArrayLike | None = None,
        halvings: int = 0,
    ) -> RodState:
        """Advance by dt [s] under constant pressures u (M,) [Pa] and point forces (N, 3) [N].

        Args:
            halvings: how often a step that does not converge may be cut in two.

        Raises:
            ConvergenceError: Newton's iteration failed.
        """
        raise NotImplementedError

    def simulate(
        self,
        state: RodState,
        pressures: ArrayLike,
        dt: float,
        *,
        substeps: int = 1,
        method: Method = "midpoint",
        forces: ArrayLike | None = None,
        linearise: bool = False,
        outputs: Sequence[int] | None = None,
    ) -> Trajectory:
        """Run K intervals of length dt in one compiled loop, each in `substeps` equal steps.

        Args:
            state: initial state.
            pressures: (K, M) held over each interval, or (K, substeps, M) one for each step [Pa].
            dt: length of an interval [s].
            substeps: S, integrator steps in an interval.
            method: integrator.
            forces: (N, 3) constant point forces [N].
            linearise: also keep the exact linearisation of every step: `Trajectory.linearisation` has
                `.tangent(pressure change) -> output change`, `.adjoint(output weight) -> gradient` and
                `.sensitivity(pulse=None)` (K+1, P, K, M), all compiled.
            outputs: (P,) indices into q of the outputs; default the tip's free coordinates.

        Raises:
            ConvergenceError: with the step's index and the last good state.
        """
        raise NotImplementedError

    def equilibrium(
        self, u: ArrayLike, *, start: RodState | None = None, forces: ArrayLike | None = None
    ) -> RodState:
        """Return the resting state under pressures u (M,) [Pa], gravity and point forces (N, 3) [N].

        Raises:
            ConvergenceError: neither Newton nor load stepping found one.
        """
        raise NotImplementedError

    def positions(self, state: RodState | ArrayLike) -> Array:
        """Return the (N, 3) node positions [m] of a state or of q."""
        raise NotImplementedError

    def tip(self, state: RodState | ArrayLike) -> Array:
        """Return the (3,) position of the last node [m]."""
        raise NotImplementedError

    def energy(self, state: RodState | ArrayLike) -> float:
        """Return the elastic energy [J]."""
        raise NotImplementedError

    def internal_force(self, state: RodState | ArrayLike) -> Array:
        """Return the elastic force −∇E (4N-1,) [N, N·m]."""
        raise NotImplementedError

    def stiffness(self, state: RodState | ArrayLike) -> Array:
        """Return the elastic Hessian ∇²E (4N-1, 4N-1) [N/m …]."""
        raise NotImplementedError

    def input_matrix(self, state: RodState | ArrayLike) -> Array:
        """Return B(q)Λ (4N-1, M) [N/Pa]: unit couples times Λ; rows of φ are zero."""
        raise NotImplementedError

    def control_affine(self, state: RodState, forces: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return f (2F,) and g (2F, M) of ẋ = f(x) + g(x) u, x = (q[free], v[free])."""
        raise NotImplementedError

    def linearise_step(
        self,
        state: RodState,
        u: ArrayLike,
        dt: float,
        method: Method = "midpoint",
        *,
        forces: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return the exact A (2F, 2F), B (2F, M) of δx' = A δx + B δu for one step from `state`.

        x = (q[free], v[free]); by the implicit function theorem at the converged step, with the
        derivative of B(q)u.
        """
        raise NotImplementedError

    def bend_angles(self, state: RodState | ArrayLike) -> Array:
        """Return (…, M) the turning of each segment about +z from its first to its last edge [rad]."""
        raise NotImplementedError

    def configuration_from_bend_angles(self, angles: ArrayLike) -> tuple[Array, Array]:
        """Return q (4N-1,) of a planar rod whose segments bend evenly, and S = ∂q/∂angles (4N-1, M).

        Args:
            angles: (M,) bend angles [rad], as `bend_angles` measures them.
        """
        raise NotImplementedError


__all__ = ["Method", "Plane", "Rod", "RodState", "Trajectory", "np"]
