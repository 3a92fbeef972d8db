"""Compiled kernels of a rod in a plane: two unknowns a node, half-bandwidth 5.

Symbols, after Bergou et al., "Discrete elastic rods" (2008) and "Discrete viscous threads" (2010),
in two dimensions: n nodes (with the ghost node, if any), x (2n,) positions, edge j = x_{j+1} − x_j
of length |e_j|, t its tangent and n̂ its left normal; at node i the turning angle θ and the
integrated curvature κ = 2 tan(θ/2), κ' = dκ/dθ = 1 + κ²/4, κ'' = κ κ'/2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod.compile import inlined_kernel, kernel
from der_planner.rod.step_kernel import Body


class PlanarRod(NamedTuple):
    """The numbers of a rod in a plane."""

    rest: Array  # (n-1,) edge lengths at rest ē [m]
    shortest: float  # of them [m]
    axial: Array  # (n-1,) EA [N]
    bend: Array  # (n,) EI/l [N·m]
    rest_kappa: Array  # (n,) κ̄
    cubic: Array  # (n,) k3/l³ [N·m]
    viscous: Array  # (n,) EI τ/l, Kelvin-Voigt [N·m·s]
    first: NDArray[np.int64]  # (M,) first edge of each segment
    last: NDArray[np.int64]  # (M,) last edge of each segment
    gain: Array  # (M,) Λ [N/Pa]
    body: Body


class PlanarSpace(NamedTuple):
    """Where the kernels work; nothing in here outlives a call."""

    x: Array  # (2n,) the solution sought
    v: Array  # (2n,) its velocity
    acceleration: Array  # (2n,) of the last solve
    residual: Array  # (2n,)
    x_start: Array  # (2n,) where a step began
    v_start: Array  # (2n,)
    s: Array  # (2n, 6) symmetric derivative of the residual, by columns
    a: Array  # (2n, 11) exact derivative, by rows
    drag: Array  # (2n, 11) viscous matrix times rate, by rows
    edge: Array  # (n-1, 3) t and 1/|e|
    turn: Array  # (n,) κ
    torque: Array  # (n, 2) moment about z and its derivative by θ
    parts: Array  # (2, 6) gradients at one node


@kernel
def edges_and_turns(x: Array, edge: Array, turn: Array) -> None:
    """Fill edge (n-1, 3) with t and 1/|e|, turn (n,) with κ at the interior nodes."""
    n = turn.shape[0]
    for j in range(n - 1):
        ex = x[2 * j + 2] - x[2 * j]
        ey = x[2 * j + 3] - x[2 * j + 1]
        inverse = 1.0 / np.sqrt(ex * ex + ey * ey)
        edge[j, 0] = ex * inverse
        edge[j, 1] = ey * inverse
        edge[j, 2] = inverse
    for i in range(1, n - 1):
        sine = edge[i - 1, 0] * edge[i, 1] - edge[i - 1, 1] * edge[i, 0]
        cosine = edge[i - 1, 0] * edge[i, 0] + edge[i - 1, 1] * edge[i, 1]
        turn[i] = 2.0 * sine / (1.0 + cosine)


@kernel
def energy(x: Array, space: PlanarSpace, rod: PlanarRod) -> float:
    """Return the elastic energy [J].

    E = Σ ½ EA (|e|/ē − 1)² ē + Σ ½ (EI/l) (κ − κ̄)² + ¼ (k3/l³) (κ − κ̄)⁴; Bergou 2008, eq. 2, with
    the stretching of Jawed et al., "A primer on the kinematics of discrete elastic rods" (2018).
    """
    rest, axial, bend = rod.rest, rod.axial, rod.bend
    rest_kappa, cubic = rod.rest_kappa, rod.cubic
    edge, turn = space.edge, space.turn
    edges_and_turns(x, edge, turn)
    total = 0.0
    n = turn.shape[0]
    for j in range(n - 1):
        strain = 1.0 / (edge[j, 2] * rest[j]) - 1.0
        total += 0.5 * axial[j] * strain * strain * rest[j]
    for i in range(1, n - 1):
        square = (turn[i] - rest_kappa[i]) ** 2
        total += 0.5 * bend[i] * square + 0.25 * cubic[i] * square * square
    return total


@inlined_kernel
def moments(v: Array, rate: float, space: PlanarSpace, rod: PlanarRod) -> None:
    """Fill torque (n, 2) from edge and turn: each node's moment about z and its derivative by θ.

    With δ = κ − κ̄ the moment is [(EI/l) δ + (k3/l³) δ³] κ' + (EI τ/l) κ'² θ̇, the last term
    Kelvin-Voigt damping of κ; θ̇ changes by rate for a change of θ.
    """
    edge, turn, torque = space.edge, space.turn, space.torque
    bend, rest_kappa, cubic, viscous = rod.bend, rod.rest_kappa, rod.cubic, rod.viscous
    n = turn.shape[0]
    for i in range(1, n - 1):
        kappa = turn[i]
        slope = 1.0 + 0.25 * kappa * kappa
        second = 0.5 * kappa * slope
        delta = kappa - rest_kappa[i]
        moment = (bend[i] + cubic[i] * delta * delta) * delta
        tangent = bend[i] + 3.0 * cubic[i] * delta * delta
        torque[i, 0] = moment * slope
        torque[i, 1] = tangent * slope * slope + moment * second
        if viscous[i] != 0.0:
            turning = turning_rate(v, edge, i)
            torque[i, 0] += viscous[i] * slope * slope * turning
            torque[i, 1] += viscous[i] * slope * (slope * rate + 2.0 * second * turning)


@inlined_kernel
def edge_derivatives(
    j: int, u: Array, convex: bool, space: PlanarSpace, rod: PlanarRod
) -> tuple[float, float, float, float, float]:
    """Return gradient (gx, gy) and Hessian (hxx, hxy, hyy) of the forces by the edge's vector e.

    An edge's energy depends on its length and, through the turning of its two nodes, on its
    direction ψ, with ∇ψ = n̂/|e|: ∇E = T t + (M_j − M_{j+1} − f |e|) n̂/|e| with the tension
    T = EA (|e|/ē − 1), the nodes' moments M, and f = ∓Λu of the couple at a segment's first or
    last edge.
    """
    first, last, gain = rod.first, rod.last, rod.gain
    edge, torque = space.edge, space.torque
    tx, ty, il = edge[j, 0], edge[j, 1], edge[j, 2]
    nx, ny = -ty * il, tx * il  # ∇ of the edge's direction angle
    tension = rod.axial[j] * (1.0 / (il * rod.rest[j]) - 1.0)
    bending = torque[j, 0] - torque[j + 1, 0]
    curving = torque[j, 1] + torque[j + 1, 1]
    follower = 0.0
    for m in range(gain.shape[0]):
        if j == first[m]:
            follower -= gain[m] * u[m]
        elif j == last[m]:
            follower += gain[m] * u[m]
    along = rod.axial[j] / rod.rest[j]
    push = bending - follower / il
    # t tᵀ, n̂ n̂ᵀ (in nx, ny scaled by 1/|e|), t n̂ᵀ + n̂ tᵀ
    side = tension / il + curving
    cross = follower - bending * il
    if convex:
        side = max(tension, 0.0) / il + curving
        cross = 0.0
    return (
        tension * tx + push * nx,
        tension * ty + push * ny,
        along * tx * tx + side * nx * nx + 2.0 * cross * tx * nx,
        along * tx * ty + side * nx * ny + cross * (tx * ny + ty * nx),
        along * ty * ty + side * ny * ny + 2.0 * cross * ty * ny,
    )


@inlined_kernel
def coupling(j: int, space: PlanarSpace) -> tuple[float, float, float, float]:
    """Return xx, xy, yx, yy of the Hessian by edges j (rows) and j+1, which turn one node."""
    edge = space.edge
    tangent = -space.torque[j + 1, 1]
    nx, ny = -edge[j, 1] * edge[j, 2], edge[j, 0] * edge[j, 2]
    mx, my = -edge[j + 1, 1] * edge[j + 1, 2], edge[j + 1, 0] * edge[j + 1, 2]
    return tangent * nx * mx, tangent * nx * my, tangent * ny * mx, tangent * ny * my


@inlined_kernel
def assemble(
    x: Array,
    v: Array,
    rate: float,
    u: Array,
    convex: bool,
    g: Array,
    space: PlanarSpace,
    rod: PlanarRod,
) -> None:
    """Elastic, viscous and actuating terms of the residual and its symmetric derivative.

    g (2n,) becomes ∇E + viscous force − B(q)Λu; space.s its derivative by x with
    v = rate·(x − x_n), of which the unsymmetric part is left out or symmetrised (`unsymmetric`
    adds what is missing). With `convex` the negative geometric terms are left out too: a safer
    direction far from the solution.
    """
    s = space.s
    n = space.turn.shape[0]
    edges_and_turns(x, space.edge, space.turn)
    moments(v, rate, space, rod)
    for k in range(2 * n):
        g[k] = 0.0
    left_xx = left_xy = left_yx = left_yy = 0.0  # coupling of edges j-1 and j, rows of j-1
    before_xx = before_xy = before_yy = 0.0  # Hessian of edge j-1
    for j in range(n - 1):
        gx, gy, hxx, hxy, hyy = edge_derivatives(j, u, convex, space, rod)
        right_xx = right_xy = right_yx = right_yy = 0.0
        if j < n - 2:
            right_xx, right_xy, right_yx, right_yy = coupling(j, space)
        k = 2 * j
        g[k] -= gx
        g[k + 1] -= gy
        g[k + 2] = gx
        g[k + 3] = gy
        s[k, 0] = before_xx + hxx - 2.0 * left_xx
        s[k, 1] = before_xy + hxy - left_xy - left_yx
        s[k + 1, 0] = before_yy + hyy - 2.0 * left_yy
        # rows of node j+1, columns of node j: −H_jj + C_jᵀ + C_{j+1}ᵀ
        s[k, 2] = -hxx + left_xx + right_xx
        s[k, 3] = -hxy + left_xy + right_xy
        s[k + 1, 1] = -hxy + left_yx + right_yx
        s[k + 1, 2] = -hyy + left_yy + right_yy
        # rows of node j+2: −C_{j+1}ᵀ
        s[k, 4] = -right_xx
        s[k, 5] = -right_xy
        s[k + 1, 3] = -right_yx
        s[k + 1, 4] = -right_yy
        s[k + 1, 5] = 0.0
        before_xx, before_xy, before_yy = hxx, hxy, hyy
        left_xx, left_xy, left_yx, left_yy = right_xx, right_xy, right_yx, right_yy
    k = 2 * n - 2
    s[k, :] = 0.0
    s[k + 1, :] = 0.0
    s[k, 0] = before_xx
    s[k, 1] = before_xy
    s[k + 1, 0] = before_yy


@kernel
def turning_rate(v: Array, edge: Array, i: int) -> float:
    """Return dθ/dt at node i for node velocities v."""
    total = 0.0
    for side in range(2):
        j = i - 1 + side
        ex = v[2 * j + 2] - v[2 * j]
        ey = v[2 * j + 3] - v[2 * j + 1]
        along = (edge[j, 0] * ey - edge[j, 1] * ex) * edge[j, 2]
        total += along if side == 1 else -along
    return total


@kernel
def unsymmetric(v: Array, rate: float, u: Array, space: PlanarSpace, rod: PlanarRod) -> None:
    """Complete space.a to the exact derivative; fill space.drag with c κ'² ∇θ ∇θᵀ times rate.

    Missing in `assemble` are −(Λu/|e|) n̂ tᵀ of a couple that keeps its force while its edge
    stretches, and c κ'² ∇θ (∇²θ v)ᵀ of the viscous moment, c = EI τ/l.
    """
    first, last, gain, viscous = rod.first, rod.last, rod.gain, rod.viscous
    a, drag, edge, turn = space.a, space.drag, space.edge, space.turn
    for m in range(gain.shape[0]):  # the couples
        for end in range(2):
            j = first[m] if end == 0 else last[m]
            force = (-gain[m] if end == 0 else gain[m]) * u[m] * edge[j, 2]
            tx, ty = edge[j, 0], edge[j, 1]
            for row in range(4):
                normal = (-ty if row % 2 == 0 else tx) * (-1.0 if row < 2 else 1.0)
                for column in range(4):
                    along = (tx if column % 2 == 0 else ty) * (-1.0 if column < 2 else 1.0)
                    a[2 * j + row, 5 + column - row] -= force * normal * along
    gradient, change = space.parts[0], space.parts[1]
    drag[:] = 0.0
    for i in range(1, turn.shape[0] - 1):  # the viscous moments
        if viscous[i] == 0.0:
            continue
        slope = 1.0 + 0.25 * turn[i] * turn[i]
        strength = viscous[i] * slope * slope
        gradient[:] = 0.0
        change[:] = 0.0
        for side in range(2):
            j = i - 1 + side
            sign = 1.0 if side == 1 else -1.0
            tx, ty, il = edge[j, 0], edge[j, 1], edge[j, 2]
            vx = v[2 * j + 2] - v[2 * j]
            vy = v[2 * j + 3] - v[2 * j + 1]
            along = (tx * vx + ty * vy) * il * il
            across = (tx * vy - ty * vx) * il * il
            k = 2 * side
            gx, gy = -sign * ty * il, sign * tx * il
            hx = -sign * (tx * across - ty * along)
            hy = -sign * (ty * across + tx * along)
            gradient[k] -= gx
            gradient[k + 1] -= gy
            gradient[k + 2] += gx
            gradient[k + 3] += gy
            change[k] -= hx
            change[k + 1] -= hy
            change[k + 2] += hx
            change[k + 3] += hy
        base = 2 * i - 2
        for row in range(6):
            for column in range(6):
                a[base + row, 5 + column - row] += strength * gradient[row] * change[column]
                drag[base + row, 5 + column - row] += (
                    strength * rate * gradient[row] * gradient[column]
                )
