"""Compiled assembly of gradient and Hessian of a rod in space; symbols as in `elastic_kernel`.

Derivatives are kept by edge, w = (e, φ), and brought to the nodes at the end.
"""

from __future__ import annotations

from der_planner.arrays import Array
from der_planner.rod.compile import inlined_kernel, kernel
from der_planner.rod.spatial.elastic_kernel import (
    SpatialRod,
    SpatialSpace,
    add_curvature_hessian,
    node_strains,
)


@inlined_kernel
def assemble(
    x: Array,
    v: Array,
    rate: float,
    u: Array,
    convex: bool,
    g: Array,
    space: SpatialSpace,
    rod: SpatialRod,
) -> None:
    """Elastic, viscous and actuating terms of the residual and its symmetric derivative.

    g (4n-1,) becomes ∇E + viscous force − B(q)Λu; space.s the symmetric derivative by x, the
    viscous part with v = rate·(x − x_n). space.frame and space.twists are those of x.

    With δ the strains less their rest values, a node's force is c1 ∇κ1 + c2 ∇κ2 + c3 ∇τ with
    c_{1,2} = (EI/l + (k3/l³) |δ|²) δ_{1,2} + (EI τ/l) κ̇_{1,2} and c3 = (GJ/l) δ3; its derivative is
    the outer products of the ∇ with the derivatives of the c, and c1 ∇²κ1 + c2 ∇²κ2 + c3 ∇²τ.
    """
    bend, twist, cubic, viscous = rod.bend, rod.twist, rod.cubic, rod.viscous
    rest_kappa, rest_twist = rod.rest_kappa, rod.rest_twist
    frame, twists, own, link = space.frame, space.twists, space.own, space.link
    local, vectors = space.local, space.vectors
    edges = frame.shape[0]
    stretch(frame, u, convex, own, rod)
    strain = local[11]
    gradient = local[8:11]
    for i in range(1, edges):
        node_strains(i, frame, twists, x, strain, gradient)
        d1 = strain[0] - rest_kappa[i, 0]
        d2 = strain[1] - rest_kappa[i, 1]
        d3 = strain[2] - rest_twist[i]
        stiff = bend[i] + cubic[i] * (d1 * d1 + d2 * d2)
        c1, c2, c3 = stiff * d1, stiff * d2, twist[i] * d3
        if viscous[i] != 0.0:
            for k in range(4):
                ve = v[4 * i + k] - v[4 * i - 4 + k] if k < 3 else v[4 * i - 1]
                vf = v[4 * i + 4 + k] - v[4 * i + k] if k < 3 else v[4 * i + 3]
                c1 += viscous[i] * (gradient[0, k] * ve + gradient[0, 4 + k] * vf)
                c2 += viscous[i] * (gradient[1, k] * ve + gradient[1, 4 + k] * vf)
            stiff += viscous[i] * rate
        weight = 2.0 * cubic[i]
        for r in range(8):
            g1, g2, g3 = stiff * gradient[0, r], stiff * gradient[1, r], twist[i] * gradient[2, r]
            gr = weight * (d1 * gradient[0, r] + d2 * gradient[1, r])
            g1 += gr * d1
            g2 += gr * d2
            for c in range(8):
                local[r, c] = g1 * gradient[0, c] + g2 * gradient[1, c] + g3 * gradient[2, c]
        add_curvature_hessian(i, c1, c2, c3, frame, strain, vectors, local)
        for r in range(8):
            side = i - 1 + r // 4
            own[side, r % 4, 4] += c1 * gradient[0, r] + c2 * gradient[1, r] + c3 * gradient[2, r]
        for r in range(4):
            for c in range(r + 1):
                own[i - 1, r, c] += local[r, c]
                own[i, r, c] += local[4 + r, 4 + c]
            for c in range(4):
                link[i, r, c] = local[4 + r, c]
    to_nodes(own, link, g, space.s)


@kernel
def stretch(frame: Array, u: Array, convex: bool, own: Array, rod: SpatialRod) -> None:
    """Start own (n-1, 4, 5) with stretching and the couples, symmetrised.

    Stretching: ∇E = T t, T = EA (|e|/ē − 1), ∇²E = (EA/ē) t tᵀ + (T/|e|) (1 − t tᵀ). A couple's
    force on its edge is ∓Λu ẑ×t.
    """
    rest, axial = rod.rest, rod.axial
    first, last, gain = rod.first, rod.last, rod.gain
    own[:] = 0.0
    for j in range(frame.shape[0]):
        inverse = frame[j, 3]
        tension = axial[j] * (1.0 / (inverse * rest[j]) - 1.0)
        across = tension * inverse
        if convex and across < 0.0:  # a safer direction far from the solution
            across = 0.0
        along = axial[j] / rest[j] - across
        for r in range(3):
            own[j, r, 4] = tension * frame[j, r]
            for c in range(r + 1):
                own[j, r, c] = along * frame[j, r] * frame[j, c]
            own[j, r, r] += across
    for m in range(gain.shape[0]):
        for end in range(2):
            j = first[m] if end == 0 else last[m]
            force = (-gain[m] if end == 0 else gain[m]) * u[m]
            nx, ny = -frame[j, 1], frame[j, 0]
            own[j, 0, 4] -= force * nx
            own[j, 1, 4] -= force * ny
            force *= frame[j, 3]
            own[j, 0, 0] += force * 2.0 * nx * frame[j, 0]
            own[j, 1, 0] += force * (ny * frame[j, 0] + nx * frame[j, 1])
            own[j, 1, 1] += force * 2.0 * ny * frame[j, 1]
            own[j, 2, 0] += force * frame[j, 2] * nx
            own[j, 2, 1] += force * frame[j, 2] * ny


@kernel
def unsymmetric(u: Array, space: SpatialSpace, rod: SpatialRod) -> None:
    """Add to space.a what `assemble` left out of the derivative at the frames' own base.

    That is the unsymmetric part of the couples, which keep turning about z when their edge tilts,
    and half of each edge's twisting torque times [t]×/|e|², as the force is no gradient under
    transport.
    """
    first, last, gain = rod.first, rod.last, rod.gain
    frame, own, a = space.frame, space.own, space.a
    for j in range(frame.shape[0]):
        half = 0.5 * own[j, 3, 4] * frame[j, 3] * frame[j, 3]
        for k in range(3):
            k1, k2 = (k + 1) % 3, (k + 2) % 3
            add_to_edge(j, k1, k2, -half * frame[j, k], a)
            add_to_edge(j, k2, k1, half * frame[j, k], a)
    for m in range(gain.shape[0]):
        for end in range(2):
            j = first[m] if end == 0 else last[m]
            force = (-gain[m] if end == 0 else gain[m]) * u[m] * frame[j, 3]
            nx, ny = -frame[j, 1], frame[j, 0]
            for c in range(3):
                tc = frame[j, c]
                nc = nx if c == 0 else (ny if c == 1 else 0.0)
                for r in range(3):
                    tr = frame[j, r]
                    nr = nx if r == 0 else (ny if r == 1 else 0.0)
                    spin = -1.0 if (r == 0 and c == 1) else (1.0 if (r == 1 and c == 0) else 0.0)
                    exact = -(spin - nr * tc)  # −[z]× (1 − t tᵀ), with [z]× t = n
                    add_to_edge(j, r, c, force * (exact - tr * nc - nr * tc), a)


@kernel
def add_to_edge(j: int, r: int, c: int, value: float, a: Array) -> None:
    """Add ∂(force by edge j)_r/∂(edge j)_c to the general band a of the nodes."""
    row, column = 4 * j + r, 4 * j + c
    a[row, 10 + column - row] += value
    a[row + 4, 10 + column - row] += value
    a[row, 14 + column - row] -= value
    a[row + 4, 6 + column - row] -= value


@kernel
def to_nodes(own: Array, link: Array, g: Array, s: Array) -> None:  # noqa: PLR0912 - one block a case
    """Bring gradient and Hessian by w_j = (x_{j+1} − x_j, φ_j) to the nodes: g (4n-1,), s."""
    edges = own.shape[0]
    for r in range(3):
        g[r] = 0.0
    for j in range(edges):
        k = 4 * j
        for r in range(3):
            g[k + r] -= own[j, r, 4]
            g[k + 4 + r] = own[j, r, 4]
        g[k + 3] = own[j, 3, 4]
        before = j > 0
        after = j < edges - 1
        for a in range(3):
            for b in range(a, 3):
                value = own[j, b, a]
                if before:
                    value += own[j - 1, b, a] - link[j, a, b] - link[j, b, a]
                s[k + a, b - a] = value
            value = -own[j, 3, a]
            if before:
                value += link[j, 3, a]
            s[k + a, 3 - a] = value
            for b in range(3):
                value = -(own[j, b, a] if b >= a else own[j, a, b])
                if before:
                    value += link[j, b, a]
                if after:
                    value += link[j + 1, b, a]
                s[k + a, 4 + b - a] = value
            s[k + a, 7 - a] = -link[j + 1, 3, a] if after else 0.0
            for b in range(3):
                s[k + a, 8 + b - a] = -link[j + 1, b, a] if after else 0.0
            for b in range(11 - a, 11):
                s[k + a, b] = 0.0
        s[k + 3, 0] = own[j, 3, 3]
        for b in range(3):
            s[k + 3, 1 + b] = own[j, 3, b] - (link[j + 1, b, 3] if after else 0.0)
            s[k + 3, 5 + b] = link[j + 1, b, 3] if after else 0.0
            s[k + 3, 8 + b] = 0.0
        s[k + 3, 4] = link[j + 1, 3, 3] if after else 0.0
    k = 4 * edges
    for a in range(3):
        for b in range(11):
            s[k + a, b] = 0.0
        for b in range(a, 3):
            s[k + a, b - a] = own[edges - 1, b, a]
