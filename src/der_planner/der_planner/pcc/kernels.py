"""Compiled kernels of the piecewise-constant-curvature (PCC) model.

The plane is written with complex numbers, x + i y. One segment with bend angle θ and length L
reaches, at the fraction σ of its length, the point L σ g(σ θ) of its own frame, with

    g(z) = ∫₀¹ exp(i z η) dη = sin z / z + i (1 − cos z) / z.

Its derivatives are g⁽ᵏ⁾(z) = iᵏ ∫₀¹ ηᵏ exp(i z η) dη, smooth through z = 0: a power series is used
there instead of the quotient, so that a straight limb is an ordinary configuration.

Symbols: q (n,) bend angles [rad], P position of a material point as a function of q, J_i = ∂P/∂q_i,
H_ik = ∂²P/∂q_i∂q_k. With these M_ij = ∫ μ ⟨J_i, J_j⟩ ds and C_ij = ∫ μ ⟨J_i, Σ_k H_jk q̇_k⟩ ds.
Since H is symmetric these are Christoffel's symbols, and Ṁ = C + Cᵀ holds exactly, term by term.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Vector = NDArray[np.float64]

SERIES_BELOW = 0.5
_SERIES_TERMS = 14


@njit(cache=True, nogil=True)
def arc_moment(z: float, k: int) -> Any:
    """Return ∫₀¹ ηᵏ exp(i z η) dη for k = 0, 1, 2, to rounding for every real z."""
    if abs(z) < SERIES_BELOW:
        total = 0.0 + 0.0j
        term = 1.0 + 0.0j
        for m in range(_SERIES_TERMS):
            total += term / (m + k + 1)
            term *= 1j * z / (m + 1)
        return total
    phase = np.cos(z) + 1j * np.sin(z)
    value = (phase - 1.0) / (1j * z)
    for order in range(1, k + 1):
        value = (phase - order * value) / (1j * z)
    return value


@njit(cache=True, nogil=True)
def arc_point(z: float, k: int) -> Any:
    """Return the k-th derivative of g at z (k = 0, 1, 2)."""
    value = arc_moment(z, k)
    if k == 1:
        return 1j * value
    if k == 2:
        return -value
    return value


@njit(cache=True, nogil=True)
def point_derivatives(
    q: Vector,
    lengths: Vector,
    connector: float,
    j: int,
    sigma: float,
    J: NDArray[np.complex128],
    H: NDArray[np.complex128],
) -> Any:
    """Return the point at fraction sigma of segment j; fill J (n,), H (n, n): its derivatives.

    A bend angle q_i turns everything beyond segment i as one body, hence the recurrences
    J_i = exp(iΦ_i) L_i g′(q_i) + i (P − p_i) and H_ik = i J_k for k > i, with p_i the end of
    segment i and Φ_i = q_0 + … + q_{i−1}.
    """
    n = q.size
    J[:] = 0.0
    H[:, :] = 0.0
    ends = np.zeros(n, dtype=np.complex128)
    headings = np.zeros(n, dtype=np.complex128)
    position = 0.0 + 0.0j
    heading = 1.0 + 0.0j
    for i in range(j):
        headings[i] = heading
        position = position + heading * lengths[i] * arc_point(q[i], 0)
        ends[i] = position
        heading = heading * (np.cos(q[i]) + 1j * np.sin(q[i]))
        position = position + heading * connector
    z = sigma * q[j]
    point = position + heading * lengths[j] * sigma * arc_point(z, 0)
    J[j] = heading * lengths[j] * sigma**2 * arc_point(z, 1)
    H[j, j] = heading * lengths[j] * sigma**3 * arc_point(z, 2)
    for i in range(j):
        beyond = point - ends[i]
        J[i] = headings[i] * lengths[i] * arc_point(q[i], 1) + 1j * beyond
        H[i, i] = headings[i] * lengths[i] * arc_point(q[i], 2) - beyond
    for i in range(j):
        for k in range(i + 1, j + 1):
            H[i, k] = 1j * J[k]
            H[k, i] = H[i, k]
    return point


@njit(cache=True, nogil=True)
def inertia(
    q: Vector,
    v: Vector,
    lengths: Vector,
    connector: float,
    masses: Vector,
    damping: Vector,
    gravity: Vector,
    fractions: Vector,
    weights: Vector,
) -> tuple[Vector, Vector, Vector, Vector]:
    """Return M (n, n), C (n, n), the mass-proportional damping D (n, n) and gravity's torque (n,).

    q, v are bend angles [rad] and their rates [rad/s], lengths [m], masses [kg] and damping [1/s]
    of the segments, all (n,); connector is the length between two segments [m], gravity (2,) is
    in m/s²; fractions and weights are the nodes and weights on [0, 1] that carry a segment's mass.
    """
    n = q.size
    M = np.zeros((n, n))
    C = np.zeros((n, n))
    D = np.zeros((n, n))
    torque = np.zeros(n)
    J = np.zeros(n, dtype=np.complex128)
    H = np.zeros((n, n), dtype=np.complex128)
    rate = np.zeros(n, dtype=np.complex128)
    for j in range(n):
        for p in range(fractions.size):
            mass = masses[j] * weights[p]
            point_derivatives(q, lengths, connector, j, fractions[p], J, H)
            for i in range(j + 1):
                total = 0.0 + 0.0j
                for k in range(j + 1):
                    total += H[i, k] * v[k]
                rate[i] = total
            for i in range(j + 1):
                torque[i] += mass * (J[i].real * gravity[0] + J[i].imag * gravity[1])
                for k in range(j + 1):
                    product = J[i].real * J[k].real + J[i].imag * J[k].imag
                    M[i, k] += mass * product
                    D[i, k] += mass * damping[j] * product
                    C[i, k] += mass * (J[i].real * rate[k].real + J[i].imag * rate[k].imag)
    return M, C, D, torque


@njit(cache=True, nogil=True)
def acceleration(
    q: Vector,
    v: Vector,
    torque: Vector,
    lengths: Vector,
    connector: float,
    masses: Vector,
    damping: Vector,
    gravity: Vector,
    fractions: Vector,
    weights: Vector,
    stiffness: Vector,
    cubic: Vector,
    rest: Vector,
    material_damping: Vector,
) -> Vector:
    """Return q̈ from M q̈ + C q̇ + D q̇ + K(q) = torque, all (n,)."""
    M, C, D, weight = inertia(
        q, v, lengths, connector, masses, damping, gravity, fractions, weights
    )
    bend = q - rest
    elastic = stiffness * (bend + material_damping * v) + cubic * bend**3
    force = torque + weight - elastic - (C + D) @ v
    return np.linalg.solve(M, force)


@njit(cache=True, nogil=True)
def simulate(
    q: Vector,
    v: Vector,
    pressures: Vector,
    step: float,
    gain: Vector,
    lengths: Vector,
    connector: float,
    masses: Vector,
    damping: Vector,
    gravity: Vector,
    fractions: Vector,
    weights: Vector,
    stiffness: Vector,
    cubic: Vector,
    rest: Vector,
    material_damping: Vector,
) -> tuple[Vector, Vector]:
    """Roll the model forward with the classical Runge-Kutta method.

    pressures (K, S, n) [Pa] are constant over each of the S steps of an interval, step [s] is that
    of the integrator, gain (n,) the moment per pressure [N·m/Pa]; the others are those of
    `acceleration`. Returns angles and rates (K + 1, n) at the interval boundaries.
    """
    count, substeps, n = pressures.shape
    angles = np.zeros((count + 1, n))
    rates = np.zeros((count + 1, n))
    angles[0] = q
    rates[0] = v
    slopes = np.zeros((4, n))
    for k in range(count):
        for s in range(substeps):
            torque = gain * pressures[k, s]
            q_stage, v_stage = q, v
            q_total, v_total = np.zeros(n), np.zeros(n)
            for stage in range(4):
                slopes[stage] = acceleration(
                    q_stage, v_stage, torque, lengths, connector, masses, damping, gravity,
                    fractions, weights, stiffness, cubic, rest, material_damping,
                )  # fmt: skip
                share = 2.0 if stage in (1, 2) else 1.0
                q_total += share * v_stage
                v_total += share * slopes[stage]
                ahead = step if stage == 2 else 0.5 * step
                q_stage, v_stage = q + ahead * v_stage, v + ahead * slopes[stage]
            q = q + step / 6.0 * q_total
            v = v + step / 6.0 * v_total
        angles[k + 1] = q
        rates[k + 1] = v
    return angles, rates
