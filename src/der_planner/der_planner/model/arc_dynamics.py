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

from der_planner.model.arc_kernel import arc_point

Vector = NDArray[np.float64]
Complex = NDArray[np.complex128]

_STAGES = np.array([[5.0 / 12.0, -1.0 / 12.0], [0.75, 0.25]])
"""The Radau IIA method: shares of both stages' slopes in what a stage holds; the second one is the
end of the step."""
_AT, _BY = _STAGES.sum(axis=1), _STAGES @ _STAGES
"""Instants of the stages, and shares of their accelerations in a stage's angle."""
_NEWTON_STEPS, _MOST_PARTS = 12, 1024
"""Most iterations of a step, and most parts of one."""
_TOLERANCE = 1e-5
"""Relative change of the accelerations in the last iteration."""
_FARTHEST = 0.3
"""Change of an angle by its acceleration up to which a step is short enough [rad]: in longer ones
Newton's method may find accelerations of another motion."""


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
def needed_torque(q: Vector, v: Vector, a: Vector, arcs: Arcs) -> Vector:
    """Return R = M q̈ + (C + D) q̇ + K(q) − gravity's torque (n,).

    It is summed particle by particle: m (Σ_i J_i q̈_i + Σ_kl H_kl q̇_k q̇_l − g) and the drag on its
    velocity, by the particle's J. M, C and D, of which only the products count, are not formed.
    """
    n = q.size
    J, H = np.zeros(n, dtype=np.complex128), np.zeros((n, n), dtype=np.complex128)
    pull = complex(arcs.gravity[0], arcs.gravity[1])
    frame = joints(q, arcs)
    slopes = arc_slopes(q, arcs, frame, 2)
    needed = np.empty(n)
    for i in range(n):
        bend = q[i] - arcs.rest[i]
        needed[i] = arcs.stiffness[i] * (bend + arcs.viscous[i] * v[i]) + arcs.cubic[i] * bend**3
    for p in range(arcs.owner.size):
        last = arcs.owner[p] + 1
        point_derivatives(q, arcs, frame, p, slopes, J, H)
        velocity, acceleration = 0.0 + 0.0j, 0.0 + 0.0j
        for i in range(last):
            velocity += J[i] * v[i]
            acceleration += J[i] * a[i] + H[i, i] * v[i] * v[i]
            for k in range(i):
                acceleration += 2.0 * H[i, k] * v[i] * v[k]
        felt = arcs.mass[p] * acceleration - arcs.weight[p] * pull + arcs.drag[p] * velocity
        for i in range(last):
            needed[i] += J[i].real * felt.real + J[i].imag * felt.imag
    return needed


@njit(cache=True, nogil=True)
def needed_torques(q: Vector, v: Vector, a: Vector, arcs: Arcs) -> Vector:
    """Return `needed_torque` (K, n) at K angles, rates and accelerations."""
    result = np.empty_like(q)
    for k in range(len(q)):
        result[k] = needed_torque(q[k], v[k], a[k], arcs)
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


@njit(cache=True, nogil=True, inline="always")
def _step(
    q: Vector, v: Vector, torque: Vector, h: float, a: Vector, arcs: Arcs, linearise: bool
) -> tuple[bool, Vector, Vector, Vector]:
    """Take one step of the Radau IIA method, both stages together by Newton's method.

    ``a`` (2, n) holds a guess of the stages' accelerations, and those that were found. Returns
    whether they were, angles and rates after the step, and their derivatives (2n, 3n) by those
    before it and by the pressures.
    """
    n = q.size
    matrix, left, columns = np.empty((2 * n, 2 * n)), np.empty(2 * n), np.zeros((2 * n, 3 * n))
    by = np.eye(2 * n, 3 * n)
    for _ in range(_NEWTON_STEPS):
        for i in range(2):
            q_i = q + h * _AT[i] * v + h**2 * (_BY[i, 0] * a[0] + _BY[i, 1] * a[1])
            v_i = v + h * (_STAGES[i, 0] * a[0] + _STAGES[i, 1] * a[1])
            by_angle, by_rate, M = force_slopes(q_i, v_i, a[i], arcs)
            rows = slice(i * n, (i + 1) * n)
            left[rows] = torque - needed_torque(q_i, v_i, a[i], arcs)
            for j in range(2):
                block = h**2 * _BY[i, j] * by_angle + h * _STAGES[i, j] * by_rate
                matrix[rows, j * n : (j + 1) * n] = block + M if i == j else block
            if linearise:
                columns[rows, :n] = -by_angle
                columns[rows, n : 2 * n] = -by_rate - h * _AT[i] * by_angle
                columns[rows, 2 * n :] = np.diag(arcs.gain)
        change = np.linalg.solve(matrix, left)
        a += change.reshape(2, n)
        error = np.abs(change).max() / (1.0 + np.abs(a).max())
        if not error > _TOLERANCE:
            break
    q = q + h * v + h**2 * (_BY[1, 0] * a[0] + _BY[1, 1] * a[1])
    v = v + h * (_STAGES[1, 0] * a[0] + _STAGES[1, 1] * a[1])
    if linearise:
        pushed = np.linalg.solve(matrix, columns)
        by[:n] += h * by[n:] + h**2 * (_BY[1, 0] * pushed[:n] + _BY[1, 1] * pushed[n:])
        by[n:] += h * (_STAGES[1, 0] * pushed[:n] + _STAGES[1, 1] * pushed[n:])
    found = error <= _TOLERANCE and h**2 * np.abs(a).max() <= _FARTHEST
    return found, q, v, by


@njit(cache=True, nogil=True)
def simulate(
    q: Vector, v: Vector, pressures: Vector, h: float, arcs: Arcs, linearise: bool
) -> tuple[Vector, Vector, Vector, Vector]:
    """Roll the model forward with the Radau IIA method of two stages, of order 3.

    It is stable whatever the step h [s], also where material damping is large, and lets motion die
    down that is too fast for the step (Hairer and Wanner, Solving Ordinary Differential Equations
    II, IV.5). A step in which Newton's method fails, or that is too long for its motion, is taken
    in 2, 4, 8 … parts.

    pressures (K, S, n) [Pa] are constant over each of the S steps of an interval. Returns angles
    and rates (K + 1, n) at the interval boundaries, NaN from where a step was not found.

    To linearise each step, also A (K, S, 2n, 2n) and B (K, S, 2n, n): x′ = A x + B u for changes of
    x = (q, v) and of the step's pressures u; else these are empty.
    """
    count, substeps, n = pressures.shape
    angles, rates = np.full((count + 1, n), np.nan), np.full((count + 1, n), np.nan)
    kept = count if linearise else 0
    A = np.zeros((kept, substeps, 2 * n, 2 * n))
    B = np.zeros((kept, substeps, 2 * n, n))
    angles[0], rates[0] = q, v
    a = np.zeros((2, n))
    for k in range(count):
        for s in range(substeps):
            torque, parts, done = arcs.gain * pressures[k, s], 1, 0
            while done < parts:
                if done == 0:
                    q_part, v_part, dx = q, v, np.eye(2 * n, 3 * n)
                found, q_part, v_part, by = _step(
                    q_part, v_part, torque, h / parts, a, arcs, linearise
                )
                if linearise:
                    dx = by[:, : 2 * n] @ dx
                    dx[:, 2 * n :] += by[:, 2 * n :]
                done += 1
                if not found:
                    parts, done = 2 * parts, 0
                    a[:] = 0.0
                    if parts > _MOST_PARTS:
                        return angles, rates, A, B
            q, v = q_part, v_part
            if linearise:
                A[k, s], B[k, s] = dx[:, : 2 * n], dx[:, 2 * n :]
        angles[k + 1], rates[k + 1] = q, v
    return angles, rates, A, B
