"""Compiled kernels of a rod in space: four unknowns a node, half-bandwidth 10.

Symbols: n nodes (with the ghost node, if any), x (4n-1,) = x0, φ0, x1, …; edge j = x_{j+1} − x_j
with tangent t; d̂, t̂ the reference director and tangent of the last converged step, d1 = P(t̂→t) d̂
the director now, m1, m2 the material frame at φ; at node i κb = 2 t_e×t_f / χ, χ = 1 + t_e·t_f, and

    κ1 = ½ κb·(m2e + m2f),  κ2 = −½ κb·(m1e + m1f),  τ = φf − φe + reference twist

(Bergou et al., "Discrete viscous threads", 2010, sections 3 and 4).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod.compile import kernel
from der_planner.rod.step_kernel import Base, Body


class SpatialRod(NamedTuple):
    """The numbers of a rod in space."""

    rest: Array  # (n-1,) edge lengths at rest ē [m]
    shortest: float  # of them [m]
    axial: Array  # (n-1,) EA [N]
    bend: Array  # (n,) EI/l [N·m]
    twist: Array  # (n,) GJ/l [N·m]
    cubic: Array  # (n,) k3/l³ [N·m]
    viscous: Array  # (n,) EI τ/l, Kelvin-Voigt [N·m·s]
    rest_kappa: Array  # (n, 2) κ̄
    rest_twist: Array  # (n,) τ̄ [rad]
    first: NDArray[np.int64]  # (M,) first edge of each segment
    last: NDArray[np.int64]  # (M,) last edge of each segment
    gain: Array  # (M,) Λ [N/Pa]
    body: Body


class SpatialSpace(NamedTuple):
    """Where the kernels work; but for `base` nothing in here outlives a call."""

    base: Base  # the frames that the angles count from
    x: Array  # (4n-1,) the solution sought
    v: Array  # (4n-1,) its velocity
    acceleration: Array  # (4n-1,) of the last solve
    residual: Array  # (4n-1,)
    x_start: Array  # (4n-1,) where a step began
    v_start: Array  # (4n-1,)
    base_start: Base  # frames there
    s: Array  # (4n-1, 11) symmetric derivative of the residual, by columns
    a: Array  # (4n-1, 21) exact derivative, by rows
    drag: Array  # (4n-1, 21) derivative by −x_n without inertia, by rows
    turning: Array  # (4n-1, 21) the part of it by the turning of the frames
    frame: Array  # (n-1, 13) t, 1/|e|, m1, m2, d1 of each edge
    twists: Array  # (n,) reference twists [rad]
    own: Array  # (n-1, 4, 5) Hessian by each edge's (e, φ), gradient in the last column
    link: Array  # (n, 4, 4) coupling of a node's two edges, rows of the second
    local: Array  # (12, 8) Hessian, gradients and strains at one node
    vectors: Array  # (10, 3) vectors at one node


# Columns of `frame` at which t and d1 begin
T, D1 = 0, 10


@kernel
def frames(x: Array, base: Base, frame: Array) -> None:
    """Fill frame (n-1, 13): t, 1/|e|, m1, m2 and the transported director of each edge."""
    base_tangent, base_director = base.tangents, base.directors
    for j in range(frame.shape[0]):
        k = 4 * j
        ex = x[k + 4] - x[k]
        ey = x[k + 5] - x[k + 1]
        ez = x[k + 6] - x[k + 2]
        inverse = 1.0 / np.sqrt(ex * ex + ey * ey + ez * ez)
        tx, ty, tz = ex * inverse, ey * inverse, ez * inverse
        bx, by, bz = base_tangent[j, 0], base_tangent[j, 1], base_tangent[j, 2]
        dx, dy, dz = base_director[j, 0], base_director[j, 1], base_director[j, 2]
        # P d = d − (t·d)/(1 + t̂·t) (t̂ + t) for d ⟂ t̂
        shift = (tx * dx + ty * dy + tz * dz) / (1.0 + bx * tx + by * ty + bz * tz)
        dx -= shift * (bx + tx)
        dy -= shift * (by + ty)
        dz -= shift * (bz + tz)
        sx, sy, sz = ty * dz - tz * dy, tz * dx - tx * dz, tx * dy - ty * dx
        c, s = np.cos(x[k + 3]), np.sin(x[k + 3])
        frame[j, 0] = tx
        frame[j, 1] = ty
        frame[j, 2] = tz
        frame[j, 3] = inverse
        frame[j, 4] = c * dx + s * sx
        frame[j, 5] = c * dy + s * sy
        frame[j, 6] = c * dz + s * sz
        frame[j, 7] = -s * dx + c * sx
        frame[j, 8] = -s * dy + c * sy
        frame[j, 9] = -s * dz + c * sz
        frame[j, 10] = dx
        frame[j, 11] = dy
        frame[j, 12] = dz


@kernel
def reference_twists(frame: Array, before: Array, twists: Array) -> None:
    """Fill twists (n,): angle from P(t_e→t_f) d1_e to d1_f about t_f, the one near `before`."""
    for i in range(1, frame.shape[0]):
        ex, ey, ez = frame[i - 1, 0], frame[i - 1, 1], frame[i - 1, 2]
        fx, fy, fz = frame[i, 0], frame[i, 1], frame[i, 2]
        dx, dy, dz = frame[i - 1, 10], frame[i - 1, 11], frame[i - 1, 12]
        ux, uy, uz = frame[i, 10], frame[i, 11], frame[i, 12]
        shift = (fx * dx + fy * dy + fz * dz) / (1.0 + ex * fx + ey * fy + ez * fz)
        dx -= shift * (ex + fx)
        dy -= shift * (ey + fy)
        dz -= shift * (ez + fz)
        cosine = dx * ux + dy * uy + dz * uz
        sine = fx * (dy * uz - dz * uy) + fy * (dz * ux - dx * uz) + fz * (dx * uy - dy * ux)
        old = before[i]
        if sine == 0.0 and cosine > 0.0 and old == 0.0:
            twists[i] = 0.0
            continue
        angle = np.arctan2(sine, cosine)
        twists[i] = angle + 2.0 * np.pi * np.floor((old - angle) / (2.0 * np.pi) + 0.5)


@kernel
def node_strains(
    i: int, frame: Array, twists: Array, x: Array, strain: Array, gradient: Array
) -> None:
    """Fill strain (8,): κ1, κ2, τ, χ, κb and gradient (3, 8) of κ1, κ2, τ by (e, φe, f, φf)."""
    ex, ey, ez, le = frame[i - 1, 0], frame[i - 1, 1], frame[i - 1, 2], frame[i - 1, 3]
    fx, fy, fz, lf = frame[i, 0], frame[i, 1], frame[i, 2], frame[i, 3]
    chi = 1.0 + ex * fx + ey * fy + ez * fz
    over = 1.0 / chi
    bx = 2.0 * over * (ey * fz - ez * fy)
    by = 2.0 * over * (ez * fx - ex * fz)
    bz = 2.0 * over * (ex * fy - ey * fx)
    qx, qy, qz = over * (ex + fx), over * (ey + fy), over * (ez + fz)
    strain[2] = x[4 * i + 3] - x[4 * i - 1] + twists[i]
    strain[3] = chi
    strain[4] = bx
    strain[5] = by
    strain[6] = bz
    for k in range(2):
        column = 7 if k == 0 else 4
        sign = 1.0 if k == 0 else -1.0
        aex, aey, aez = frame[i - 1, column], frame[i - 1, column + 1], frame[i - 1, column + 2]
        afx, afy, afz = frame[i, column], frame[i, column + 1], frame[i, column + 2]
        kappa = 0.5 * sign * (bx * (aex + afx) + by * (aey + afy) + bz * (aez + afz))
        strain[k] = kappa
        sx, sy, sz = sign * over * (aex + afx), sign * over * (aey + afy), sign * over * (aez + afz)
        gradient[k, 0] = le * (-kappa * qx + fy * sz - fz * sy)
        gradient[k, 1] = le * (-kappa * qy + fz * sx - fx * sz)
        gradient[k, 2] = le * (-kappa * qz + fx * sy - fy * sx)
        gradient[k, 4] = lf * (-kappa * qx - ey * sz + ez * sy)
        gradient[k, 5] = lf * (-kappa * qy - ez * sx + ex * sz)
        gradient[k, 6] = lf * (-kappa * qz - ex * sy + ey * sx)
        other = 4 if k == 0 else 7  # ∂m2/∂φ = −m1, ∂m1/∂φ = m2: −½ κb·m for both
        gradient[k, 3] = -0.5 * (
            bx * frame[i - 1, other] + by * frame[i - 1, other + 1] + bz * frame[i - 1, other + 2]
        )
        gradient[k, 7] = -0.5 * (
            bx * frame[i, other] + by * frame[i, other + 1] + bz * frame[i, other + 2]
        )
    gradient[2, 0] = 0.5 * le * bx
    gradient[2, 1] = 0.5 * le * by
    gradient[2, 2] = 0.5 * le * bz
    gradient[2, 3] = -1.0
    gradient[2, 4] = 0.5 * lf * bx
    gradient[2, 5] = 0.5 * lf * by
    gradient[2, 6] = 0.5 * lf * bz
    gradient[2, 7] = 1.0


@kernel
def add_curvature_hessian(
    i: int, c1: float, c2: float, c3: float, frame: Array, strain: Array, vectors: Array, h: Array
) -> None:
    """Add c1 ∇²κ1 + c2 ∇²κ2 + c3 ∇²τ, symmetric, to h (8, 8), whose lower triangle is filled.

    With a = c1 m2 − c2 m1 on each edge, c1 κ1 + c2 κ2 = ½ κb·(a_e + a_f): one formula does both.
    """
    value = curvature_vectors(i, c1, c2, frame, strain, vectors)
    over = 1.0 / strain[3]
    inverse = (frame[i - 1, 3], frame[i, 3])
    t, a, p = vectors[0:2], vectors[2:4], vectors[6:8]
    q, s, kb = vectors[8], vectors[9], strain[4:7]
    for side in range(2):
        square = inverse[side] * inverse[side]
        at = 4 * side
        for r in range(3):
            for c in range(r + 1):
                eye = 1.0 if r == c else 0.0
                h[at + r, at + c] += square * (
                    2.0 * value * q[r] * q[c]
                    - p[side, r] * q[c]
                    - q[r] * p[side, c]
                    - value * over * (eye - t[side, r] * t[side, c])
                    + 0.25 * (kb[r] * a[side, c] + a[side, r] * kb[c])
                    - 0.25 * c3 * (kb[r] * (t[side, c] + q[c]) + (t[side, r] + q[r]) * kb[c])
                )
    both = inverse[0] * inverse[1]
    for r in range(3):  # rows of f, columns of e
        for c in range(3):
            eye = 1.0 if r == c else 0.0
            h[4 + r, c] += both * (
                -value * over * (eye + t[0, c] * t[1, r])
                + 2.0 * value * q[r] * q[c]
                - p[0, c] * q[r]
                - p[1, r] * q[c]
                - 0.5 * c3 * kb[c] * q[r]
            )
    # −[ã]× + (c3/χ) [t_e]× for (rows e, columns f), here transposed
    wx, wy, wz = c3 * over * t[0, 0] - s[0], c3 * over * t[0, 1] - s[1], c3 * over * t[0, 2] - s[2]
    h[4, 1] += both * wz
    h[4, 2] -= both * wy
    h[5, 0] -= both * wz
    h[5, 2] += both * wx
    h[6, 0] += both * wy
    h[6, 1] -= both * wx
    add_angle_rows(inverse, strain, vectors, h)


@kernel
def curvature_vectors(
    i: int, c1: float, c2: float, frame: Array, strain: Array, vectors: Array
) -> float:
    """Fill vectors (10, 3) with t, a, ∂a/∂φ and p of both edges, t̃ and ã; return ½ κb·(a_e + a_f).

    t̃ = (t_e + t_f)/χ, ã = (a_e + a_f)/χ; p is t_f × ã for e, and −t_e × ã for f.
    """
    t, a, b, p = vectors[0:2], vectors[2:4], vectors[4:6], vectors[6:8]
    q, s, kb = vectors[8], vectors[9], strain[4:7]
    over, value = 1.0 / strain[3], 0.0
    for k in range(3):
        for side in range(2):
            j = i - 1 + side
            t[side, k] = frame[j, k]
            a[side, k] = c1 * frame[j, 7 + k] - c2 * frame[j, 4 + k]
            b[side, k] = -c1 * frame[j, 4 + k] - c2 * frame[j, 7 + k]  # ∂a/∂φ
        q[k] = over * (t[0, k] + t[1, k])
        s[k] = over * (a[0, k] + a[1, k])
        value += 0.5 * kb[k] * (a[0, k] + a[1, k])
    for side in range(2):
        other = 1 - side
        sign = 1.0 if side == 0 else -1.0
        p[side, 0] = sign * (t[other, 1] * s[2] - t[other, 2] * s[1])
        p[side, 1] = sign * (t[other, 2] * s[0] - t[other, 0] * s[2])
        p[side, 2] = sign * (t[other, 0] * s[1] - t[other, 1] * s[0])
    return value


@kernel
def add_angle_rows(inverse: tuple[float, float], strain: Array, vectors: Array, h: Array) -> None:
    """Add the derivatives by the two angles φ to h (8, 8); ``inverse`` holds 1/|e| and 1/|f|."""
    t, a, b = vectors[0:2], vectors[2:4], vectors[4:6]
    q, kb = vectors[8], strain[4:7]
    over = 1.0 / strain[3]
    for side in range(2):
        row = 3 + 4 * side
        half = 0.0
        curl = 0.0
        for k in range(3):
            half += 0.5 * kb[k] * b[side, k]
            curl += 0.5 * kb[k] * a[side, k]
        h[row, row] -= curl
        for k in range(3):
            k1, k2 = (k + 1) % 3, (k + 2) % 3
            by_e = inverse[0] * (
                -half * q[k] + over * (t[1, k1] * b[side, k2] - t[1, k2] * b[side, k1])
            )
            by_f = inverse[1] * (
                -half * q[k] - over * (t[0, k1] * b[side, k2] - t[0, k2] * b[side, k1])
            )
            h[row, k] += by_e
            if side == 0:
                h[4 + k, row] += by_f
            else:
                h[row, 4 + k] += by_f


@kernel
def energy(x: Array, space: SpatialSpace, rod: SpatialRod) -> float:
    """Return the elastic energy [J]; space.frame and space.twists are those of x.

    E = Σ ½ EA (|e|/ē − 1)² ē + Σ ½ (EI/l) |κ − κ̄|² + ¼ (k3/l³) |κ − κ̄|⁴ + ½ (GJ/l) (τ − τ̄)².
    """
    rest, axial, bend, twist, cubic = rod.rest, rod.axial, rod.bend, rod.twist, rod.cubic
    rest_kappa, rest_twist = rod.rest_kappa, rod.rest_twist
    frame, twists, local = space.frame, space.twists, space.local
    total = 0.0
    strain = local[11]
    for j in range(frame.shape[0]):
        strained = 1.0 / (frame[j, 3] * rest[j]) - 1.0
        total += 0.5 * axial[j] * strained * strained * rest[j]
    for i in range(1, frame.shape[0]):
        node_strains(i, frame, twists, x, strain, local[8:11])
        square = (strain[0] - rest_kappa[i, 0]) ** 2 + (strain[1] - rest_kappa[i, 1]) ** 2
        total += 0.5 * bend[i] * square + 0.25 * cubic[i] * square * square
        total += 0.5 * twist[i] * (strain[2] - rest_twist[i]) ** 2
    return total
