"""Compiled kernels of the piecewise-constant-curvature (PCC) model.

The plane is written with complex numbers, x + i y. One segment with bend angle θ and length L
reaches, at the fraction σ of its length, the point L σ g(σ θ) of its own frame, with

    g(z) = ∫₀¹ exp(i z η) dη = sin z / z + i (1 − cos z) / z.

A straight limb is an ordinary configuration, see `arc_kernel`.

Symbols: q (n,) bend angles [rad], P position of a particle as a function of q, J_i = ∂P/∂q_i,
H_ik = ∂²P/∂q_i∂q_k. With the particles' masses m, M_ij = Σ m ⟨J_i, J_j⟩, C_ij = Σ m ⟨J_i, Σ_k H_jk
q̇_k⟩ and gravity's torque is Σ m ⟨J_i, g⟩. Since H is symmetric these are Christoffel's symbols, and
Ṁ = C + Cᵀ holds exactly, term by term: C is needed, and formed, only as C q̇. The particles are the
quadrature points of the distributed mass and what the limb carries.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from der_planner.model.arc_kernel import arc_point, factorise, substitute

Vector = NDArray[np.float64]
Complex = NDArray[np.complex128]


class Arcs(NamedTuple):
    """A limb of n arcs and P particles, in SI units."""

    lengths: Vector  # (n,)
    connector: float  # length between two segments
    gravity: Vector  # (2,)
    owner: NDArray[np.int64]  # (P,) segment of each particle
    place: Vector  # (P,) fraction of its segment's length
    beyond: Vector  # (P,) distance past the segment's end, on the connector behind it
    mass: Vector  # (P,) that resists acceleration
    weight: Vector  # (P,) mass that gravity pulls at
    drag: Vector  # (P,) damping coefficient [kg/s]
    gain: Vector  # (n,) moment per pressure [N·m/Pa]
    stiffness: Vector  # (n,) EI / L
    cubic: Vector  # (n,) k3 / L³
    rest: Vector  # (n,) bend at rest
    viscous: Vector  # (n,) Kelvin-Voigt time [s]


@njit(cache=True, nogil=True, inline="always")
def joints(q: Vector, arcs: Arcs) -> Complex:
    """Return (3, n + 1): where each segment starts, its first heading, and where it ends."""
    n = q.size
    result = np.zeros((3, n + 1), dtype=np.complex128)
    position, heading = 0.0 + 0.0j, 1.0 + 0.0j
    for i in range(n):
        result[0, i], result[1, i] = position, heading
        position = position + heading * arcs.lengths[i] * arc_point(q[i])[0]
        result[2, i] = position
        heading = heading * (np.cos(q[i]) + 1j * np.sin(q[i]))
        position = position + heading * arcs.connector
    result[0, n], result[1, n] = position, heading
    return result


@njit(cache=True, nogil=True, inline="always")
def point_derivatives(
    q: Vector, arcs: Arcs, frame: Complex, p: int, slopes: Complex, J: Complex, H: Complex
) -> Any:
    """Return where particle p is; fill J (n,) and H (n, n), its first and second derivatives.

    A bend angle q_i turns everything beyond segment i as one body, hence the recurrences
    J_i = exp(iΦ_i) L_i g′(q_i) + i (P − p_i) and H_ik = i J_k for k > i, with p_i the end of
    segment i and Φ_i = q_0 + … + q_{i−1}. ``frame`` is that of `joints`, ``slopes`` (2, n) holds
    exp(iΦ_i) L_i times g′ and g″ (`arc_slopes`).
    """
    J[:] = 0.0
    H[:, :] = 0.0
    j, sigma = arcs.owner[p], arcs.place[p]
    z, reach = sigma * q[j], frame[1, j] * arcs.lengths[j] * sigma
    past = frame[1, j + 1] * arcs.beyond[p]
    bent, slope, curve, _ = arc_point(z)
    point = frame[0, j] + reach * bent + past
    J[j] = reach * sigma * slope + 1j * past
    H[j, j] = reach * sigma**2 * curve - past
    for i in range(j):
        past = point - frame[2, i]
        J[i] = slopes[0, i] + 1j * past
        H[i, i] = slopes[1, i] - past
    for i in range(j):
        for k in range(i + 1, j + 1):
            H[i, k] = 1j * J[k]
            H[k, i] = H[i, k]
    return point


@njit(cache=True, nogil=True, inline="always")
def arc_slopes(q: Vector, arcs: Arcs, frame: Complex, order: int) -> Complex:
    """Return exp(iΦ_i) L_i times the derivatives 1 … order (2 or 3) of g at each bend angle."""
    n = q.size
    result = np.zeros((order, n), dtype=np.complex128)
    for i in range(n):
        _, first, second, third = arc_point(q[i])
        turned = frame[1, i] * arcs.lengths[i]
        result[0, i], result[1, i] = turned * first, turned * second
        if order > 2:
            result[2, i] = turned * third
    return result


@njit(cache=True, nogil=True, inline="always")
def inertia_and_force(q: Vector, v: Vector, torque: Vector, arcs: Arcs) -> tuple[Vector, Vector]:
    """Return M (n, n), its lower half, and torque + gravity's torque − (C + D) q̇ − K(q) (n,).

    The forces are summed particle by particle: m (g − Σ_kl H_kl q̇_k q̇_l) less the drag on its
    velocity, by the particle's J. C and D, of which only the products with q̇ count, are not formed.
    """
    n = q.size
    M = np.zeros((n, n))
    J, H = np.zeros(n, dtype=np.complex128), np.zeros((n, n), dtype=np.complex128)
    pull = complex(arcs.gravity[0], arcs.gravity[1])
    frame = joints(q, arcs)
    slopes = arc_slopes(q, arcs, frame, 2)
    force = np.empty(n)
    for i in range(n):
        bend = q[i] - arcs.rest[i]
        force[i] = torque[i] - arcs.stiffness[i] * (bend + arcs.viscous[i] * v[i])
        force[i] -= arcs.cubic[i] * bend**3
    for p in range(arcs.owner.size):
        mass, last = arcs.mass[p], arcs.owner[p] + 1
        point_derivatives(q, arcs, frame, p, slopes, J, H)
        velocity, turning = 0.0 + 0.0j, 0.0 + 0.0j
        for i in range(last):
            velocity += J[i] * v[i]
            turning += H[i, i] * v[i] * v[i]
            for k in range(i):
                turning += 2.0 * H[i, k] * v[i] * v[k]
        felt = arcs.weight[p] * pull - mass * turning - arcs.drag[p] * velocity
        for i in range(last):
            force[i] += J[i].real * felt.real + J[i].imag * felt.imag
            for k in range(i + 1):
                M[i, k] += mass * (J[i].real * J[k].real + J[i].imag * J[k].imag)
    return M, force


@njit(cache=True, nogil=True, inline="always")
def acceleration(q: Vector, v: Vector, torque: Vector, arcs: Arcs) -> Any:
    """Return q̈ (n,) from M q̈ + C q̇ + D q̇ + K(q) = torque + gravity's torque."""
    M, force = inertia_and_force(q, v, torque, arcs)
    factorise(M)
    substitute(M, force)
    return force


@njit(cache=True, nogil=True)
def needed_torque(q: Vector, v: Vector, a: Vector, arcs: Arcs) -> Vector:
    """Return M q̈ + C q̇ + D q̇ + K(q) − gravity's torque (K, n) at angles, rates, accelerations."""
    result = np.empty_like(q)
    for k in range(len(q)):
        M, force = inertia_and_force(q[k], v[k], np.zeros(q.shape[1]), arcs)
        for i in range(q.shape[1]):
            result[k, i] = -force[i]
            for j in range(q.shape[1]):
                result[k, i] += M[max(i, j), min(i, j)] * a[k, j]
    return result


# The linearisation ------------------------------------------------------------------------------


@njit(cache=True, nogil=True, inline="always")
def _third(
    q: Vector, v: Vector, arcs: Arcs, frame: Complex, p: int, point: Any, third: Complex, H: Complex
) -> Complex:
    """Return Σ_kl T_skl v_k v_l (n,), T = ∂³P/∂q³ of particle p.

    T_skl = i H of the two larger indices, unless all three are one: everything beyond the segment
    of the smallest index turns as one body. ``third`` (n,) holds exp(iΦ_i) L_i g‴(q_i).
    """
    j, sigma = arcs.owner[p], arcs.place[p]
    out = np.zeros(q.size, dtype=np.complex128)
    for s in range(j + 1):
        for k in range(j + 1):
            for m in range(j + 1):
                if s == k and k == m:
                    if s == j:
                        reach = frame[1, j] * arcs.lengths[j] * sigma**4
                        value = reach * arc_point(sigma * q[j])[3]
                        value = value - 1j * frame[1, j + 1] * arcs.beyond[p]
                    else:
                        value = third[s] - 1j * (point - frame[2, s])
                elif s <= k and s <= m:
                    value = 1j * H[k, m]
                elif k <= s and k <= m:
                    value = 1j * H[s, m]
                else:
                    value = 1j * H[s, k]
                out[s] += value * v[k] * v[m]
    return out


@njit(cache=True, nogil=True)
def force_slopes(q: Vector, v: Vector, a: Vector, arcs: Arcs) -> tuple[Vector, Vector, Vector]:
    """Return ∂R/∂q, ∂R/∂v and M (n, n) of R = M a + (C + D) v + K(q) − gravity's torque.

    Exact; with v = a = 0 the first is the stiffness of a resting limb.
    """
    n = q.size
    by_angle, by_rate, M = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n))
    J = np.zeros(n, dtype=np.complex128)
    H = np.zeros((n, n), dtype=np.complex128)
    turning = np.zeros(n, dtype=np.complex128)
    pushing = np.zeros(n, dtype=np.complex128)
    frame = joints(q, arcs)
    slopes = arc_slopes(q, arcs, frame, 3)
    pull = arcs.gravity[0] + 1j * arcs.gravity[1]
    for p in range(arcs.owner.size):
        mass, drag, last = arcs.mass[p], arcs.drag[p], arcs.owner[p] + 1
        point = point_derivatives(q, arcs, frame, p, slopes, J, H)
        third = _third(q, v, arcs, frame, p, point, slopes[2], H)
        speed, acceleration_ = 0.0 + 0.0j, 0.0 + 0.0j
        for s in range(last):
            turn, push = 0.0 + 0.0j, 0.0 + 0.0j
            for k in range(last):
                turn += H[s, k] * v[k]
                push += H[s, k] * a[k]
            turning[s], pushing[s] = turn, push
            speed += J[s] * v[s]
            acceleration_ += J[s] * a[s] + turn * v[s]
        felt = mass * acceleration_ - arcs.weight[p] * pull + drag * speed
        for i in range(last):
            for s in range(last):
                moved = mass * (pushing[s] + third[s]) + drag * turning[s]
                by_angle[i, s] += H[i, s].real * felt.real + H[i, s].imag * felt.imag
                by_angle[i, s] += J[i].real * moved.real + J[i].imag * moved.imag
                moved = 2.0 * mass * turning[s] + drag * J[s]
                by_rate[i, s] += J[i].real * moved.real + J[i].imag * moved.imag
                M[i, s] += mass * (J[i].real * J[s].real + J[i].imag * J[s].imag)
    for i in range(n):
        bend = q[i] - arcs.rest[i]
        by_angle[i, i] += arcs.stiffness[i] + 3.0 * arcs.cubic[i] * bend**2
        by_rate[i, i] += arcs.stiffness[i] * arcs.viscous[i]
    return by_angle, by_rate, M


@njit(cache=True, nogil=True)
def simulate(
    q: Vector, v: Vector, pressures: Vector, step: float, parts: int, arcs: Arcs, linearise: bool
) -> tuple[Vector, Vector, Vector, Vector]:
    """Roll the model forward with the classical Runge-Kutta method.

    pressures (K, S, n) [Pa] are constant over each of the S steps of an interval; each step [s] is
    taken in so many parts. Returns angles and rates (K + 1, n) at the interval boundaries.

    To linearise each step, also A (K, S, 2n, 2n) and B (K, S, 2n, n): x′ = A x + B u for changes of
    x = (q, v) and of the step's pressures u; else these are empty.
    """
    count, substeps, n = pressures.shape
    angles, rates = np.zeros((count + 1, n)), np.zeros((count + 1, n))
    kept, columns = (count, 3 * n) if linearise else (0, 0)
    A = np.zeros((kept, substeps, 2 * n, 2 * n))
    B = np.zeros((kept, substeps, 2 * n, n))
    angles[0], rates[0] = q, v
    h = step / parts
    right = np.empty(n)
    for k in range(count):
        for s in range(substeps):
            torque = arcs.gain * pressures[k, s]
            # Columns: changes by q and v before the step, and by its pressures.
            dx = np.eye(2 * n, columns)
            for _ in range(parts):
                q_stage, v_stage, d_stage = q, v, dx
                q_total, v_total = np.zeros(n), np.zeros(n)
                d_total = np.zeros((2 * n, columns))
                for stage in range(4):
                    slope = acceleration(q_stage, v_stage, torque, arcs)
                    share = 2.0 if stage in (1, 2) else 1.0
                    ahead = h if stage == 2 else 0.5 * h
                    if linearise:
                        by_angle, by_rate, M = force_slopes(q_stage, v_stage, slope, arcs)
                        factorise(M)
                        d_slope = np.empty((2 * n, columns))
                        for c in range(columns):
                            for i in range(n):
                                right[i] = arcs.gain[i] if c == 2 * n + i else 0.0
                                for j in range(n):
                                    right[i] -= by_angle[i, j] * d_stage[j, c]
                                    right[i] -= by_rate[i, j] * d_stage[n + j, c]
                            substitute(M, right)
                            d_slope[:n, c] = d_stage[n:, c]
                            d_slope[n:, c] = right
                        d_total += share * d_slope
                        d_stage = dx + ahead * d_slope
                    q_total += share * v_stage
                    v_total += share * slope
                    q_stage, v_stage = q + ahead * v_stage, v + ahead * slope
                q = q + h / 6.0 * q_total
                v = v + h / 6.0 * v_total
                dx = dx + h / 6.0 * d_total
            if linearise:
                A[k, s], B[k, s] = dx[:, : 2 * n], dx[:, 2 * n :]
        angles[k + 1], rates[k + 1] = q, v
    return angles, rates, A, B
