"""The piecewise-constant-curvature limb: kinematics, exact dynamics and its inverse.

Each segment is one circular arc with one bend angle; the mass is spread over the arc (or lumped at
the end of each segment, as parts of the literature do). The equation of motion is

    M(q) q̈ + (C(q, q̇) + D(q)) q̇ + K (q − q_rest) = G u + Q_gravity

with q the (n,) bend angles [rad], u the (n,) differential pressures [Pa] and G the moment gains.
Damping is the same physical damping as the rod's: mass-proportional per segment, ∫ c μ JᵀJ ds, plus
Kelvin-Voigt in the stiffness. Gravity pulls in the plane at the distributed mass, at that of the
connectors, and at the masses that the limb carries, which are not damped.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb import Limb
from der_planner.pcc import arc_kernel, kernels
from der_planner.pcc.kernels import Arcs
from der_planner.pcc.linearisation import Linearisation

Vector = NDArray[np.float64]
Complex = NDArray[np.complex128]
MassModel = Literal["distributed", "lumped"]

QUADRATURE_POINTS = 8
"""Gauss-Legendre points a segment: exact to rounding for bends below 180 degrees."""
RESTING_STEPS = 60
LARGEST_PHASE = 1.0
"""Of the limb's fastest mode in one step of the integrator [rad]; it is unstable beyond 2.8."""


class Pcc:
    """A limb of n constant-curvature segments.

    Args:
        limb: the physical parameters; the same file as the rod's.
        mass: ``distributed`` along the arcs, or ``lumped`` at the end of each segment.

    Raises:
        ValueError: unknown mass model.
    """

    def __init__(self, limb: Limb, mass: MassModel = "distributed") -> None:
        segments = limb.segments
        self.limb = limb
        self.segment_count = limb.segment_count
        self.lengths = np.array([s.length for s in segments])
        self.base = float(limb.base_length)
        self.connector = float(limb.connector_length)
        self.masses = np.array([s.mass_per_length * s.length for s in segments])
        self.stiffness = np.array([s.bending_stiffness / s.length for s in segments])
        self.cubic = np.array([s.cubic_stiffness / s.length**3 for s in segments])
        self.rest = np.array([s.rest_curvature * s.length for s in segments])
        self.material_damping = np.array([s.material_damping for s in segments])
        self.gain = np.array([s.moment_gain for s in segments])
        if mass == "distributed":
            nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
            self.arcs = self._arcs((nodes + 1) / 2, weights / 2)
        elif mass == "lumped":
            self.arcs = self._arcs(np.ones(1), np.ones(1))
        else:
            raise ValueError(f"mass must be 'distributed' or 'lumped', got {mass!r}")

    def _arcs(self, fractions: Vector, weights: Vector) -> Arcs:
        """Return the numbers of the kernels; a segment's mass sits at fractions of its length."""
        # owner, place, beyond, mass, weight and drag of every particle
        particles: list[tuple[int, float, float, float, float, float]] = []
        for j, segment in enumerate(self.limb.segments):
            for place, weight in zip(fractions, weights * self.masses[j], strict=True):
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
            self.stiffness, self.cubic, self.rest, self.material_damping,
        )  # fmt: skip

    def _place(self, arc_length: float) -> tuple[int, float, float]:
        """Return segment, fraction of it and distance past its end [m] of a place on the limb."""
        left = arc_length - self.base
        for j, length in enumerate(self.lengths):
            last = j == self.segment_count - 1
            if left <= length or last:
                return j, min(left / length, 1.0), 0.0
            if left <= length + self.connector:
                return j, 1.0, left - length
            left -= length + self.connector
        raise AssertionError("the last segment takes what is left")

    def _check(self, name: str, value: ArrayLike) -> Vector:
        array = np.asarray(value, dtype=float)
        if array.shape != (self.segment_count,) or not np.all(np.isfinite(array)):
            raise ValueError(
                f"{name} must be {self.segment_count} finite numbers, one a segment, got {value!r}"
            )
        return array

    def tip(self, bend_angles: ArrayLike) -> Vector:
        """Return the tip (..., 2) [m] for bend angles (..., n) [rad]."""
        tip = self._joints(np.asarray(bend_angles, dtype=float))[0]
        return np.stack([tip.real, tip.imag], axis=-1)

    def tip_jacobian(self, bend_angles: ArrayLike) -> Vector:
        """Return ∂tip/∂bend angles (..., 2, n) [m/rad] for bend angles (..., n) [rad]."""
        angles = np.asarray(bend_angles, dtype=float)
        tip, ends, headings = self._joints(angles)
        columns = headings * self.lengths * _arc_ends(angles)[1] + 1j * (tip[..., None] - ends)
        return np.stack([columns.real, columns.imag], axis=-2)

    def _joints(self, angles: Vector) -> tuple[Complex, Complex, Complex]:
        """Return the tip (...), the ends of the segments and their first headings (..., n)."""
        turned = np.cumsum(angles, axis=-1)
        headings = np.exp(1j * (turned - angles))
        steps = headings * self.lengths * _arc_ends(angles)[0]
        between = np.exp(1j * turned) * self.connector
        between[..., -1] = 0.0
        ends = self.base + np.cumsum(steps, axis=-1) + np.cumsum(between, axis=-1) - between
        return ends[..., -1], ends, headings

    def curve(self, bend_angles: ArrayLike, points_per_segment: int = 12) -> Vector:
        """Return points (P, 2) [m] of the centreline from clamp to tip for one configuration."""
        q = self._check("bend_angles", bend_angles)
        position, heading = complex(self.base), 1 + 0j
        points = [0j, position] if self.base else [0j]
        for j, angle in enumerate(q):
            if j:
                position += heading * self.connector
                points.append(position)
            fractions = np.arange(1, points_per_segment + 1) / points_per_segment
            arcs = fractions * _arc_ends(fractions * angle)[0]
            points += list(position + heading * self.lengths[j] * arcs)
            position = points[-1]
            heading *= np.exp(1j * angle)
        line = np.array(points)
        return np.column_stack([line.real, line.imag])

    def matrices(self, bend_angles: ArrayLike, rates: ArrayLike) -> tuple[Vector, Vector, Vector]:
        """Return inertia M, Coriolis C and damping D, each (n, n), with Ṁ = C + Cᵀ.

        Args:
            bend_angles: (n,) [rad].
            rates: (n,) [rad/s].
        """
        M, C, D, _ = self._inertia(self._check("bend_angles", bend_angles), np.asarray(rates))
        return M, C, D + np.diag(self.stiffness * self.material_damping)

    def _inertia(self, q: Vector, v: Vector) -> tuple[Vector, Vector, Vector, Vector]:
        result: tuple[Vector, Vector, Vector, Vector] = kernels.inertia(q, v, self.arcs)
        return result

    def elastic_torque(self, bend_angles: ArrayLike) -> Vector:
        """Return the elastic torque (..., n) [N·m] that opposes bend angles (..., n) [rad]."""
        bend = np.asarray(bend_angles, dtype=float) - self.rest
        torque: Vector = self.stiffness * bend + self.cubic * bend**3
        return torque

    def resting(self, pressures: ArrayLike) -> Vector:
        """Return the bend angles (n,) [rad] at rest under effective pressures (n,) [Pa] and weight.

        By Newton's method on G u + Q_gravity = K (q − q_rest), with steps of at most 0.3 rad along
        which the energy falls: beyond the load that buckles the straight limb, a bent one is found.
        """
        drive = self.gain * self._check("pressures", pressures)
        still = np.zeros(self.segment_count)
        q: Vector = self.rest + drive / self.stiffness
        if not self.arcs.gravity.any() and not self.cubic.any():
            return q
        for _ in range(RESTING_STEPS):
            pull = self._inertia(q, still)[3] + drive - self.elastic_torque(q)
            values, vectors = np.linalg.eigh(self.stiffness_matrix(q))
            firm = np.maximum(np.abs(values), 1e-3 * self.stiffness.min())
            step = vectors @ ((vectors.T @ pull) / firm)
            q = q + step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-12))
            if np.abs(step).max() < 1e-10:
                break
        return q

    def energy(self, bend_angles: ArrayLike, rates: ArrayLike) -> float:
        """Return kinetic plus elastic plus gravity's potential energy [J]."""
        q, v = self._check("bend_angles", bend_angles), self._check("rates", rates)
        M = self._inertia(q, v)[0]
        bend = q - self.rest
        elastic = 0.5 * self.stiffness @ bend**2 + 0.25 * self.cubic @ bend**4
        arcs = self.arcs
        frame = kernels.joints(q, arcs)
        slopes = kernels.arc_slopes(q, arcs, frame, 2)
        J, H = np.zeros(q.size, dtype=complex), np.zeros((q.size, q.size), dtype=complex)
        potential = 0.0
        for p, mass in enumerate(arcs.weight):
            point = self.base + kernels.point_derivatives(q, arcs, frame, p, slopes, J, H)
            potential -= mass * (point.real * arcs.gravity[0] + point.imag * arcs.gravity[1])
        return float(0.5 * v @ M @ v + elastic + potential)

    def pressures(self, angles: ArrayLike, rates: ArrayLike, accelerations: ArrayLike) -> Vector:
        """Invert the dynamics: u = Λ† τ with τ = M q̈ + (C + D) q̇ + K (q − q_rest) − Q_gravity.

        Args:
            angles: (K, n) [rad].
            rates: (K, n) [rad/s].
            accelerations: (K, n) [rad/s²].

        Returns:
            (K, n) differential pressures [Pa].
        """
        q, v, a = (
            np.atleast_2d(np.asarray(x, dtype=float)) for x in (angles, rates, accelerations)
        )
        torque = self.elastic_torque(q) + self.stiffness * self.material_damping * v
        for k in range(len(q)):
            M, C, D, weight = self._inertia(q[k], v[k])
            torque[k] += M @ a[k] + (C + D) @ v[k] - weight
        pressures: Vector = torque / self.gain
        return pressures

    def simulate(
        self,
        pressures: ArrayLike,
        step: float,
        angles: ArrayLike | None = None,
        rates: ArrayLike | None = None,
    ) -> tuple[Vector, Vector]:
        """Roll the model forward from rest, or from a given state.

        Args:
            pressures: (K, S, n) effective differential pressures [Pa], constant over each step.
            step: of the Runge-Kutta integrator [s]; an interval lasts S steps.
            angles: (n,) at the beginning [rad]; at rest if None.
            rates: (n,) at the beginning [rad/s]; zero if None.

        Returns:
            Angles [rad] and rates [rad/s], each (K + 1, n), at the interval boundaries.

        Raises:
            ValueError: wrong shapes.
        """
        result: tuple[Vector, Vector] = kernels.simulate(*self._run(pressures, step, angles, rates))
        return result

    def linearised(
        self,
        pressures: ArrayLike,
        step: float,
        angles: ArrayLike | None = None,
        rates: ArrayLike | None = None,
    ) -> tuple[Vector, Vector, Linearisation]:
        """Roll the model forward as `simulate`, with the exact linearisation of the motion."""
        q, v, by_state, by_pressure = kernels.linearised(*self._run(pressures, step, angles, rates))
        return q, v, Linearisation(by_state, by_pressure)

    def _run(
        self, pressures: ArrayLike, step: float, angles: ArrayLike | None, rates: ArrayLike | None
    ) -> tuple[Vector, Vector, Vector, float, int, Arcs]:
        """Return the arguments of the kernels that roll the model forward."""
        inputs = np.ascontiguousarray(pressures, dtype=float)
        if inputs.ndim != 3 or inputs.shape[2] != self.segment_count:
            raise ValueError(f"pressures must be (K, S, {self.segment_count}), got {inputs.shape}")
        q = self._check("angles", self.rest if angles is None else angles)
        v = self._check("rates", np.zeros(self.segment_count) if rates is None else rates)
        return q, v, inputs, step, self._parts(step), self.arcs

    def smallest_stiffness(self, bend_angles: ArrayLike) -> float:
        """Return the smallest eigenvalue of the stiffness of arcs at rest [N·m/rad]."""
        return float(np.linalg.eigvalsh(self.stiffness_matrix(bend_angles))[0])

    def stiffness_matrix(self, bend_angles: ArrayLike) -> Vector:
        """Return ∂(elastic less gravity's torque)/∂(bend angles) (n, n) [N·m/rad], symmetric."""
        q = self._check("bend_angles", bend_angles)
        zero = np.zeros_like(q)
        matrix: Vector = kernels.force_slopes(q, zero, zero, self.arcs)[0]
        return matrix

    def _parts(self, step: float) -> int:
        """Return in how many parts the integrator takes a step, by the fastest mode of the limb."""
        zero = np.zeros(self.segment_count)
        M, _, D, _ = self._inertia(zero, zero)
        drag = np.linalg.solve(M, D + np.diag(self.stiffness * self.material_damping))
        stiff = np.linalg.solve(M, np.diag(self.stiffness))
        rates = np.block([[0 * M, np.eye(len(M))], [-stiff, -drag]])
        fastest = float(np.abs(np.linalg.eigvals(rates)).max())
        return max(1, int(np.ceil(fastest * step / LARGEST_PHASE)))


def _arc_ends(angles: Vector) -> tuple[Complex, Complex]:
    """Return g = ∫₀¹ exp(i angle η) dη and its derivative at angles [rad] of any shape."""
    arcs, slopes = arc_kernel.arcs_and_slopes(np.ravel(angles))
    return arcs.reshape(angles.shape), slopes.reshape(angles.shape)
