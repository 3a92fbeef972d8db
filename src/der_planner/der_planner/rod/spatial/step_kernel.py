"""Compiled time steps of a rod in space and their exact linearisation; see `elastic_kernel`.

The unknowns are a chart: reference directors are transported from the base configuration, and φ is
counted from them. Away from the base the transport itself depends on the tangents (holonomy): a
change δt turns the director about t by g·δt, g = t×t̂ / (1 + t̂·t), beyond what transport from the
present tangent would do, and a change δt̂ of the base turns it by g·δt̂. The force formula is not a
gradient in this chart, so its derivative is not symmetric: each edge adds half its twisting torque
times [t]×/|e|² (`assembly_kernel.unsymmetric`).
"""

from __future__ import annotations

import numpy as np

from der_planner.arrays import Array
from der_planner.rod.banded_kernel import (
    expand,
    factor_general,
    hold_fixed,
    hold_rows,
    put,
    solve_10,
    solve_columns,
)
from der_planner.rod.compile import allocating_kernel, kernel
from der_planner.rod.spatial.assembly_kernel import assemble, unsymmetric
from der_planner.rod.spatial.elastic_kernel import (
    D1,
    SpatialRod,
    SpatialSpace,
    T,
    add_curvature_hessian,
    frames,
    node_strains,
    reference_twists,
)
from der_planner.rod.step_kernel import (
    Base,
    Place,
    Record,
    Solver,
    add_inertia,
    go_on,
    input_columns,
    keep,
    predict,
)


@kernel
def carry(x: Array, space: SpatialSpace) -> None:
    """Move the reference frames to x: the arrays of space.base are filled anew."""
    base, twists, frame = space.base, space.twists, space.frame
    frames(x, base, frame)
    reference_twists(frame, base.twists, twists)
    for j in range(frame.shape[0]):
        for k in range(3):
            base.tangents[j, k] = frame[j, T + k]
            base.directors[j, k] = frame[j, D1 + k]
        base.twists[j] = twists[j]


@kernel
def put_base(source: Base, target: Base) -> None:
    """Copy the frames."""
    for j in range(source.tangents.shape[0]):
        put(source.tangents[j], target.tangents[j])
        put(source.directors[j], target.directors[j])
    put(source.twists, target.twists)


@kernel
def largest_change(update: Array) -> tuple[float, float]:
    """Return the largest component of a Newton update by position [m] and by angle [rad]."""
    move = 0.0
    turn = 0.0
    for k in range(update.shape[0]):
        # written so that NaN counts as too large
        change = abs(update[k])
        if k % 4 == 3:
            if not change <= turn:
                turn = change
        elif not change <= move:
            move = change
    return move, turn


@kernel
def newton(
    x: Array, x_n: Array, v_n: Array, rate: float, u: Array, solver: Solver,
    space: SpatialSpace, rod: SpatialRod
) -> tuple[int, float]:  # fmt: skip
    """Solve M rate ((x − x_n) rate − v_n) + D rate (x − x_n) = F(x) for x, from the guess in x.

    rate = 0 is statics, where the reference frames follow each iterate. Returns (iterations, size
    of the last update); iterations is negative without convergence. The update is a length: an
    angle counts times solver.lever [m].
    """
    residual, v, s, a = space.residual, space.v, space.s, space.a
    base, body, fixed = space.base, rod.body, rod.body.fixed
    limit, lever = solver.limit, solver.lever
    size = x.shape[0]
    largest, careful = 2.0 * rod.shortest, 0.1 * rod.shortest
    update = np.inf
    convex = False
    for iteration in range(limit):
        for k in range(size):
            v[k] = (x[k] - x_n[k]) * rate
        frames(x, base, space.frame)
        reference_twists(space.frame, base.twists, space.twists)
        assemble(x, v, rate, u, convex, residual, space, rod)
        add_inertia(residual, s, v, v_n, rate, body)
        # Inertia makes the symmetric part of the derivative good enough; rest does not.
        if rate == 0.0 or iteration > 5:
            expand(s, a)
            unsymmetric(u, space, rod)
            hold_fixed(s, residual, fixed)
            hold_rows(a, fixed, 1.0)
            factor_general(a)
            solve_columns(a, residual.reshape(size, 1))
        else:
            hold_fixed(s, residual, fixed)
            solve_10(s, residual)
        update, turn = largest_change(residual)
        if not max(update, turn) < 1e6:
            return -iteration - 1, update
        scale = min(1.0, largest / max(update, largest), 0.7 / max(turn, 0.7))
        convex = rate > 0.0 and update > careful
        update = max(update, lever * turn)
        for k in range(size):
            x[k] -= scale * residual[k]
        if rate == 0.0:
            # Far from their base the frames' holonomy, which the derivative leaves out, would slow
            # the iteration down; at rest nothing depends on when the frames were carried along.
            carry(x, space)
        if update < solver.tolerance:
            return iteration + 1, update
    return -limit, update


@kernel
def simulate(
    motion: tuple[Array, Array], place: Place, pressures: Array, begin: int, solver: Solver,
    record: Record, space: SpatialSpace, rod: SpatialRod
) -> tuple[int, int, float, int]:  # fmt: skip
    """Run K intervals of S steps under pressures (K, S, M) from step `begin` on.

    `place` holds the state before that step, its frames being those of `space`, and in the end the
    state after the last step or before the one that failed. `motion`, q and v (K+1, 4n-1), receives
    the state after each interval, the record the linearisation of the solves unless it is empty.

    Returns (index of the failed step or K·S, Newton iterations, last update, iterations of the
    failed solve or 0).
    """
    intervals, steps, _ = pressures.shape
    q, v = motion
    x_n, v_n, base = place.x, place.v, space.base
    x, acceleration = space.x, space.acceleration
    acceleration[:] = 0.0
    stages = solver.extrapolate.shape[0]
    rate, far = 1.0 / solver.h, 0.5 * rod.shortest
    total = 0
    for index in range(begin, intervals * steps):
        k, step = index // steps, index % steps
        u = pressures[k, step]
        put(x_n, space.x_start)
        put(v_n, space.v_start)
        put_base(base, space.base_start)
        for stage in range(stages):
            predict(x, x_n, v_n, acceleration, solver.h, rod.body.fixed, far, True)
            iterations, update = newton(x, x_n, v_n, rate, u, solver, space, rod)
            if iterations < 0:  # the guess may have been at fault: once more from rest
                put(x_n, x)
                iterations, update = newton(x, x_n, v_n, rate, u, solver, space, rod)
            if iterations < 0:
                put(space.x_start, x_n)
                put(space.v_start, v_n)
                put_base(space.base_start, base)
                return index, total - iterations, update, -iterations
            total += iterations
            extrapolate = solver.extrapolate[stage]
            if record.factors.shape[0] > 0:
                slot = (index - begin) * stages + stage
                linearise(x, x_n, rate, u, record.inputs[slot], space, rod)
                keep(slot, space, record)
                gauge_of_step(x, x_n, extrapolate, record.gauge[slot], space)
            go_on(x, x_n, v_n, acceleration, rate, extrapolate)
            carry(x_n, space)
        if step == steps - 1:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
    return intervals * steps, total, 0.0, 0


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
    x: Array, x_n: Array, rate: float, u: Array, columns: Array, space: SpatialSpace,
    rod: SpatialRod
) -> None:  # fmt: skip
    """Fill space.a with the exact derivative J of a solve's residual at x, the frames' base at x_n.

    space.drag receives the derivative by −x_n without inertia, columns (4n-1, M) B(q)Λ. Fixed
    unknowns keep the value that they had: unit rows in J and in space.drag.
    """
    a, v, frame, drag, body = space.a, space.v, space.frame, space.drag, rod.body
    for k in range(x.shape[0]):
        v[k] = (x[k] - x_n[k]) * rate
    frames(x, space.base, frame)
    reference_twists(frame, space.base.twists, space.twists)
    # rate 0: the viscous matrix, which acts on x − x_n, is kept apart in `drag`
    assemble(x, v, 0.0, u, False, space.residual, space, rod)
    expand(space.s, a)
    unsymmetric(u, space, rod)
    drag[:] = 0.0
    for i in range(1, frame.shape[0]):
        if rod.viscous[i] != 0.0:
            add_viscous(i, x, rate, rod.viscous[i], space)
    add_gauge(x, x_n, space)
    for d in range(x.shape[0]):
        for k in range(21):
            a[d, k] += drag[d, k]
            drag[d, k] += space.turning[d, k]
        a[d, 10] += rate * (body.mass[d] * rate + body.damping[d])
    hold_rows(a, body.fixed, 1.0)
    hold_rows(drag, body.fixed, 1.0)
    input_columns(frame, 4, rod, columns)
    for d in body.fixed:
        for m in range(columns.shape[1]):
            columns[d, m] = 0.0


@kernel
def add_gauge(x: Array, x_n: Array, space: SpatialSpace) -> None:
    """Let the frames of space.a turn with their edges: add its φ columns times the holonomy.

    space.turning becomes minus the same for a change of the base x_n.
    """
    a, back = space.a, space.turning
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
