"""A limb of piecewise constant curvature: kinematics, exact dynamics and its inverse.

Each segment is one circular arc with one bend angle; the mass is spread over the arc. The equation
of motion is

    M(q) q̈ + (C(q, q̇) + D(q)) q̇ + K (q − q_rest) = G u + Q_gravity

with q the (n,) bend angles [rad], u the (n,) differential pressures [Pa] and G the moment gains.
Damping is the same physical damping as the rod's: mass-proportional per segment, ∫ c μ JᵀJ ds, plus
Kelvin-Voigt in the stiffness. Gravity pulls in the plane at the distributed mass, at that of the
connectors, and at the masses that the limb carries, which are not damped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model import arc_dynamics as kernels
from der_planner.model.arc_dynamics import Arcs
from der_planner.model.arc_kernel import arcs_and_slopes
from der_planner.model.model import NODES, ArcState, Model, Outputs, Rollout, State

Complex = NDArray[np.complex128]

QUADRATURE_POINTS = 6
"""Gauss-Legendre points a segment: exact to 1e-11 for bends below 90 degrees, 1e-9 below 180."""
_RESTING_STEPS = 60
"""Newton's steps to the pose at rest at the most."""


@dataclass(frozen=True)
class ArcFirstOrder:
    """`FirstOrder` of arcs along a motion of K intervals, S steps.

    Attributes:
        tip_by_angle: (K+1, 2, M) ∂tip/∂bend angles [m/rad].
        by_state: (K, S, 2M, 2M) of each step: the change of bend angles and rates after it by
            theirs before it.
        by_pressure: (K, S, 2M, M) by the pressures of the step [rad/Pa], [rad/s/Pa].
    """

    tip_by_angle: Array
    by_state: Array
    by_pressure: Array

    def tangent(self, effective: Array, start: Array | None = None) -> tuple[Array, Array]:
        """Return the changes of tip and bend angles, see `FirstOrder.tangent`."""
        count, steps, size, n = self.by_pressure.shape
        x = np.zeros((size, *effective.shape[3:]))
        if start is not None:
            x[:n] = start
        moved = np.empty((count + 1, n, *effective.shape[3:]))
        moved[0] = x[:n]
        for k in range(count):
            for s in range(steps):
                x = self.by_state[k, s] @ x + self.by_pressure[k, s] @ effective[k, s]
            moved[k + 1] = x[:n]
        return np.einsum("kan,kn...->ka...", self.tip_by_angle, moved), moved

    def sensitivity(self, pulse: Array | None = None) -> Array:
        """Return ∂tip/∂input, see `FirstOrder.sensitivity`."""
        count, steps, _, n = self.by_pressure.shape
        shape = np.ones((steps, n)) if pulse is None else pulse
        inputs, own = np.zeros((count * steps, n, count, n)), np.arange(n)
        for k in range(count):
            raised = inputs[k * steps :][: len(shape)]
            raised[:, own, k, own] = shape[: len(raised)]
        return self.tangent(inputs.reshape(count, steps, n, -1))[0].reshape(count + 1, 2, count, n)


class ArcModel(Model):
    """A limb of n constant-curvature segments; it is its own `Kinematics`.

    Args:
        limb: the physical parameters; the same file as the rod's.
    """

    name = "pcc"
    rest: ArcState

    def __init__(self, limb: Limb, nodes: int = NODES) -> None:
        super().__init__(limb, nodes)
        segments = limb.segments
        self.lengths = np.array([s.length for s in segments])
        self.base = float(limb.base_length)
        self.connector = float(limb.connector_length)
        self.masses = np.array([s.mass_per_length * s.length for s in segments])
        self.stiffness = np.array([s.bending_stiffness / s.length for s in segments])
        self.cubic = np.array([s.cubic_stiffness / s.length**3 for s in segments])
        self.free_angles = np.array([s.rest_curvature * s.length for s in segments])
        self.gain = np.array([s.moment_gain for s in segments])
        self.arcs = self._arcs()
        self.kinematics = self

    def _arcs(self) -> Arcs:
        """Return the numbers of the kernels, with the mass at quadrature points."""
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
        # owner, place, beyond, mass, weight and drag of every particle
        particles: list[tuple[int, float, float, float, float, float]] = []
        for j, segment in enumerate(self.limb.segments):
            for place, weight in zip((nodes + 1) / 2, weights / 2 * self.masses[j], strict=True):
                mass = weight * segment.swing_inertia
                particles.append((j, place, 0.0, mass, weight, weight * segment.damping))
            if j and self.connector:
                # Two Gauss points carry the moments of a straight piece exactly.
                before = self.limb.segments[j - 1]
                half = 0.25 * self.connector * (before.mass_per_length + segment.mass_per_length)
                drag = 0.5 * half * (before.damping + segment.damping)
                mass = 0.5 * half * (before.swing_inertia + segment.swing_inertia)
                for share in (0.5 - np.sqrt(1 / 12), 0.5 + np.sqrt(1 / 12)):
                    beyond = share * self.connector
                    particles.append((j - 1, 1.0, beyond, mass, half, drag))
        particles += [
            (*self._place(item.arc_length), item.mass, item.mass, 0.0)
            for item in self.limb.masses
            if item.arc_length > self.base
        ]
        owner, place, beyond, masses, pulled, drag = np.array(particles, dtype=float).T.copy()
        return Arcs(
            self.lengths, self.connector, np.array(self.limb.gravity[:2], dtype=float),
            owner.astype(np.int64), place, beyond, masses, pulled, drag, self.gain,
            self.stiffness, self.cubic, self.free_angles,
            np.array([s.material_damping for s in self.limb.segments]),
        )  # fmt: skip

    def _place(self, arc_length: float) -> tuple[int, float, float]:
        """Return segment, fraction of it and distance past its end [m] of a place on the limb."""
        left, spans = arc_length - self.base, self.lengths + self.connector
        last = self.inputs - 1
        j = min(int(np.searchsorted(np.cumsum(spans), left)), last)
        inside = left - spans[:j].sum()
        past = 0.0 if j == last else max(inside - self.lengths[j], 0.0)
        return j, min(inside / self.lengths[j], 1.0), past

    def _check(self, name: str, value: ArrayLike) -> Array:
        array = np.asarray(value, dtype=float)
        if array.shape != (self.inputs,) or not np.all(np.isfinite(array)):
            raise ValueError(
                f"{name} must be {self.inputs} finite numbers, one a segment, got {value!r}"
            )
        return array

    def tip(self, bend_angles: ArrayLike) -> Array:
        """Return the tip (..., 2) [m] for bend angles (..., n) [rad]."""
        tip = self._joints(np.asarray(bend_angles, dtype=float))[0]
        return np.stack([tip.real, tip.imag], axis=-1)

    def tip_jacobians(self, bend_angles: ArrayLike) -> Array:
        """Return ∂tip/∂bend angles (..., 2, n) [m/rad] for bend angles (..., n) [rad]."""
        angles = np.asarray(bend_angles, dtype=float)
        tip, ends, headings = self._joints(angles)
        columns = headings * self.lengths * _arc_ends(angles)[1] + 1j * (tip[..., None] - ends)
        return np.stack([columns.real, columns.imag], axis=-2)

    def _joints(self, angles: Array) -> tuple[Complex, Complex, Complex]:
        """Return the tip (...), the ends of the segments and their first headings (..., n)."""
        turned = np.cumsum(angles, axis=-1)
        headings = np.exp(1j * (turned - angles))
        steps = headings * self.lengths * _arc_ends(angles)[0]
        between = np.exp(1j * turned) * self.connector
        between[..., -1] = 0.0
        ends = self.base + np.cumsum(steps, axis=-1) + np.cumsum(between, axis=-1) - between
        return ends[..., -1], ends, headings

    def curve(self, bend_angles: ArrayLike, points_per_segment: int = 12) -> Array:
        """Return points (P, 2) [m] of the centreline from clamp to tip for one configuration."""
        q = self._check("bend_angles", bend_angles)
        _, ends, headings = self._joints(q)
        fractions = np.arange(points_per_segment + 1) / points_per_segment
        arcs = fractions * _arc_ends(q[:, None] * fractions)[0]
        arcs *= (headings * self.lengths)[:, None]
        points = (ends[:, None] + arcs - arcs[:, -1:]).ravel()
        line = np.append(0.0, points) if self.base else points
        return np.column_stack([line.real, line.imag])

    def elastic_torque(self, bend_angles: ArrayLike) -> Array:
        """Return the elastic torque (..., n) [N·m] that opposes bend angles (..., n) [rad]."""
        bend = np.asarray(bend_angles, dtype=float) - self.free_angles
        torque: Array = self.stiffness * bend + self.cubic * bend**3
        return torque

    def state(self, angles: ArrayLike, rates: ArrayLike) -> ArcState:
        """Return the arcs at bend angles and rates (M,) [rad], [rad/s]."""
        return ArcState(self._check("angles", angles), self._check("rates", rates))

    def resting(self, effective: Array) -> ArcState:
        """Return the arcs at rest under effective pressures (M,) [Pa] and their weight.

        By Newton's method on G u + Q_gravity = K (q − q_rest), with steps of at most 0.3 rad along
        which the energy falls: beyond the load that buckles the straight limb, a bent one is found.
        """
        drive = self.gain * self._check("pressures", effective)
        still = np.zeros(self.inputs)
        q: Array = self.free_angles + drive / self.stiffness
        for _ in range(_RESTING_STEPS):
            pull = drive - kernels.needed_torque(q, still, still, self.arcs)
            values, vectors = np.linalg.eigh(self.stiffness_matrix(q))
            firm = np.maximum(np.abs(values), 1e-3 * self.stiffness.min())
            step = vectors @ ((vectors.T @ pull) / firm)
            q = q + step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-12))
            if np.abs(step).max() < 1e-10:
                break
        return ArcState(q, still)

    def rest_slope(self, state: ArcState, _effective: Array) -> Array:
        """Return ∂angles/∂effective (n, n) [rad/Pa] of arcs at rest."""
        return np.asarray(np.linalg.solve(self.stiffness_matrix(state.angles), np.diag(self.gain)))

    def inverse_dynamics(
        self, angles: ArrayLike, rates: ArrayLike, accelerations: ArrayLike
    ) -> Array:
        """Invert the dynamics: u = Λ† τ with τ = M q̈ + (C + D) q̇ + K (q − q_rest) − Q_gravity.

        Args:
            angles: (K, n) [rad].
            rates: (K, n) [rad/s].
            accelerations: (K, n) [rad/s²].

        Returns:
            (K, n) differential pressures [Pa].
        """
        q, v, a = (
            np.atleast_2d(np.ascontiguousarray(x, dtype=float))
            for x in (angles, rates, accelerations)
        )
        pressures: Array = kernels.needed_torques(q, v, a, self.arcs) / self.gain
        return pressures

    def static_pressure(self, bend_angles: ArrayLike) -> Array:
        """Return the pressures (..., n) [Pa] that hold bend angles (..., n) [rad] at rest."""
        angles = np.asarray(bend_angles, dtype=float)
        if not self.is_loaded:
            pressure: Array = self.elastic_torque(angles) / self.gain
            return pressure
        flat = angles.reshape(-1, angles.shape[-1])
        return self.inverse_dynamics(flat, 0 * flat, 0 * flat).reshape(angles.shape)

    def run(
        self, start: State, effective: Array, period: float, linearise: Outputs = ""
    ) -> Rollout:
        """Simulate the arcs by steps of the Radau method, see `Model.run`; NaN where it fails.

        Raises:
            ValueError: wrong shapes.
        """
        if not isinstance(start, ArcState):
            raise TypeError("the arcs start from a state of the arcs, got one of the rod")
        inputs = np.ascontiguousarray(effective, dtype=float)
        if inputs.ndim != 3 or inputs.shape[2] != self.inputs:
            raise ValueError(f"pressures must be (K, S, {self.inputs}), got {inputs.shape}")
        step, linear = period / inputs.shape[1], None
        angles, rates, by_state, by_pressure = kernels.simulate(
            start.angles, start.rates, inputs, step, self.arcs, bool(linearise)
        )
        if linearise:
            linear = ArcFirstOrder(self.tip_jacobians(angles), by_state, by_pressure)
        return Rollout(angles, self.tip(angles), ArcState(angles[-1], rates[-1]), linear=linear)

    def smallest_stiffness(self, bend_angles: ArrayLike) -> float:
        """Return the smallest eigenvalue of the stiffness of arcs at rest [N·m/rad]."""
        return float(np.linalg.eigvalsh(self.stiffness_matrix(bend_angles))[0])

    def stiffness_matrix(self, bend_angles: ArrayLike) -> Array:
        """Return ∂(elastic less gravity's torque)/∂(bend angles) (n, n) [N·m/rad], symmetric."""
        q = self._check("bend_angles", bend_angles)
        zero = np.zeros_like(q)
        matrix: Array = kernels.force_slopes(q, zero, zero, self.arcs)[0]
        return matrix


def _arc_ends(angles: Array) -> tuple[Complex, Complex]:
    """Return g = ∫₀¹ exp(i angle η) dη and its derivative at angles [rad] of any shape."""
    arcs, slopes = arcs_and_slopes(np.ravel(angles))
    return arcs.reshape(angles.shape), slopes.reshape(angles.shape)
