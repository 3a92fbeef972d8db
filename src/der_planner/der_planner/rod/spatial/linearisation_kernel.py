"""Compiled exact linearisation of one solve of a rod in space; symbols as in `elastic_kernel`.

The unknowns are a chart: reference directors are transported from the base configuration, and φ is
counted from them. Away from the base the transport itself depends on the tangents (holonomy): a
change δt turns the director about t by g·δt, g = t×t̂ / (1 + t̂·t), beyond what transport from the
present tangent would do, and a change δt̂ of the base turns it by g·δt̂. The force formula is not a
gradient in this chart, so its derivative is not symmetric: each edge adds half its twisting torque
times [t]×/|e|² (`assembly_kernel.unsymmetric`).
"""

from __future__ import annotations

import numpy as np

from der_planner.rod.banded_kernel import expand, hold_rows
from der_planner.rod.compile import allocating_kernel, kernel
from der_planner.rod.spatial.assembly_kernel import assemble, unsymmetric
from der_planner.rod.spatial.elastic_kernel import (
    Base,
    SpatialRod,
    SpatialSpace,
    add_curvature_hessian,
    frames,
    input_columns,
    node_strains,
    reference_twists,
)
from der_planner.rod.state import Array
from der_planner.rod.step_kernel import Body


@kernel
def holonomy(start: Array, end: Array, out: Array) -> None:
    """Fill out (6,) with the turning of P(start→end) d about `end` by δend, then by δstart.

    start, end: (3,) edges [m], not normalised; out [rad/m] is by edge vectors.
    """
    short = np.sqrt(start[0] * start[0] + start[1] * start[1] + start[2] * start[2])
    long = np.sqrt(end[0] * end[0] + end[1] * end[1] + end[2] * end[2])
    dot = (start[0] * end[0] + start[1] * end[1] + start[2] * end[2]) / (short * long)
    over = 1.0 / ((1.0 + dot) * short * long)
    for k in range(3):
        k1, k2 = (k + 1) % 3, (k + 2) % 3
        normal = over * (end[k1] * start[k2] - end[k2] * start[k1])
        out[k] = normal / long
        out[3 + k] = normal / short


@kernel
def edge_of(j: int, x: Array, out: Array) -> None:
    """Fill out (3,) with edge j of x."""
    for k in range(3):
        out[k] = x[4 * j + 4 + k] - x[4 * j + k]


@kernel
def gauge_of_step(
    x: Array, x_n: Array, extrapolate: float, gauge: Array, space: SpatialSpace
) -> None:
    """Fill gauge (n-1, 6) of `Record` for the state x_n + extrapolate (x − x_n)."""
    before, after = space.vectors[0], space.vectors[1]
    for j in range(gauge.shape[0]):
        edge_of(j, x_n, before)
        edge_of(j, x, after)
        for k in range(3):
            after[k] = before[k] + extrapolate * (after[k] - before[k])
        holonomy(before, after, gauge[j])


@kernel
def linearise(
    x: Array, x_n: Array, rate: float, u: Array, base: Base, back: Array, columns: Array,
    space: SpatialSpace, body: Body, rod: SpatialRod,
) -> None:  # fmt: skip
    """Fill space.a with the exact derivative J of a solve's residual at x, from base at x_n.

    back (4n-1, 21) receives the derivative by −x_n without inertia, columns (4n-1, M) B(q)Λ. Fixed
    unknowns keep the value that they had: unit rows in J and in back.
    """
    a, v, frame = space.a, space.v, space.frame
    for k in range(x.shape[0]):
        v[k] = (x[k] - x_n[k]) * rate
    frames(x, base, frame)
    reference_twists(frame, base.twists, space.twists)
    # rate 0: the viscous matrix, which acts on x − x_n, is kept apart in `drag`
    assemble(x, v, 0.0, u, False, space.residual, space, rod)
    expand(space.s, a)
    unsymmetric(u, space, rod)
    space.drag[:] = 0.0
    for i in range(1, frame.shape[0]):
        if rod.viscous[i] != 0.0:
            add_viscous(i, x, rate, rod.viscous[i], space)
    add_gauge(x, x_n, back, space)
    for d in range(x.shape[0]):
        for k in range(21):
            a[d, k] += space.drag[d, k]
            back[d, k] += space.drag[d, k]
        a[d, 10] += rate * (body.mass[d] * rate + body.damping[d])
    hold_rows(a, body.fixed, 1.0)
    hold_rows(back, body.fixed, 1.0)
    input_columns(frame, rod, columns)
    for d in body.fixed:
        for m in range(columns.shape[1]):
            columns[d, m] = 0.0


@kernel
def add_gauge(x: Array, x_n: Array, back: Array, space: SpatialSpace) -> None:
    """Let the frames of space.a turn with their edges: add its φ columns times the holonomy.

    back (4n-1, 21) becomes minus the same for a change of the base x_n.
    """
    a = space.a
    before, after = space.vectors[0], space.vectors[1]
    turning = space.vectors[2:4].reshape(6)
    back[:] = 0.0
    for j in range(space.frame.shape[0]):
        edge_of(j, x_n, before)
        edge_of(j, x, after)
        holonomy(before, after, turning)
        angle = 4 * j + 3
        for row in range(max(0, angle - 10), min(x.shape[0], angle + 11)):
            value = a[row, 10 + angle - row]
            if value == 0.0:
                continue
            for k in range(3):
                near = 10 + angle - 3 + k - row  # column of component k of the edge's first node
                a[row, near] -= value * turning[k]
                a[row, near + 4] += value * turning[k]
                back[row, near] += value * turning[3 + k]
                back[row, near + 4] -= value * turning[3 + k]


@allocating_kernel
def add_viscous(i: int, x: Array, rate: float, strength: float, space: SpatialSpace) -> None:
    """Add c ∇κ (∇²κ v)ᵀ to space.a and c rate ∇κ ∇κᵀ to space.drag, both curvatures of node i."""
    frame, v, local = space.frame, space.v, space.local
    hessian, gradient, strain = local[0:8], local[8:11], local[11]
    node_strains(i, frame, space.twists, x, strain, gradient)
    base = 4 * i - 4
    outward = np.zeros(11)
    change = np.zeros(11)
    by_edges = np.zeros(8)
    for curvature in range(2):
        hessian[:] = 0.0
        c1 = 1.0 if curvature == 0 else 0.0
        add_curvature_hessian(i, c1, 1.0 - c1, 0.0, frame, strain, space.vectors, hessian)
        for r in range(8):
            for c in range(r):
                hessian[c, r] = hessian[r, c]
        for side in range(2):  # the force is no gradient under transport: see above
            j, at = i - 1 + side, 4 * side
            half = 0.5 * gradient[curvature, at + 3] * frame[j, 3] * frame[j, 3]
            for k in range(3):
                k1, k2 = (k + 1) % 3, (k + 2) % 3
                hessian[at + k1, at + k2] -= half * frame[j, k]
                hessian[at + k2, at + k1] += half * frame[j, k]
        by_edges[:] = 0.0
        for side in range(2):
            for k in range(4):
                at = 4 * (i - 1 + side) + k
                speed = v[at + 4] - v[at] if k < 3 else v[at]
                for c in range(8):
                    by_edges[c] += hessian[4 * side + k, c] * speed
        to_node_span(gradient[curvature], outward)
        to_node_span(by_edges, change)
        for r in range(11):
            for c in range(11):
                space.a[base + r, 10 + c - r] += strength * outward[r] * change[c]
                space.drag[base + r, 10 + c - r] += strength * rate * outward[r] * outward[c]


@kernel
def to_node_span(by_edges: Array, out: Array) -> None:
    """Fill out (11,), by the nodes' unknowns from x_{i-1} on, from by_edges, by (e, φe, f, φf)."""
    for k in range(3):
        out[k] = -by_edges[k]
        out[4 + k] = by_edges[k] - by_edges[4 + k]
        out[8 + k] = by_edges[4 + k]
    out[3] = by_edges[3]
    out[7] = by_edges[7]
