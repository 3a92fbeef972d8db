"""Compiled time steps of a planar rod; see `elastic_kernel` for the symbols."""

from __future__ import annotations

import numpy as np

from der_planner.arrays import Array
from der_planner.rod.banded_kernel import (
    expand,
    factor_general,
    hold_fixed,
    hold_rows,
    put,
    solve_5,
    solve_columns,
)
from der_planner.rod.compile import kernel
from der_planner.rod.planar.elastic_kernel import (
    PlanarRod,
    PlanarSpace,
    assemble,
    unsymmetric,
)
from der_planner.rod.step_kernel import (
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
def newton(
    x: Array, x_n: Array, v_n: Array, rate: float, u: Array, solver: Solver,
    space: PlanarSpace, rod: PlanarRod
) -> tuple[int, float]:  # fmt: skip
    """Solve M rate ((x − x_n) rate − v_n) + D rate (x − x_n) = F(x) for x, from the guess in x.

    rate = 0 is statics. Returns (iterations, size of the last update [m]); iterations is negative
    without convergence.
    """
    residual, v, s, a = space.residual, space.v, space.s, space.a
    body, fixed, limit = rod.body, rod.body.fixed, solver.limit
    size = x.shape[0]
    largest, careful = 2.0 * rod.shortest, 0.1 * rod.shortest
    update = np.inf
    convex = False
    for iteration in range(limit):
        for k in range(size):
            v[k] = (x[k] - x_n[k]) * rate
        assemble(x, v, rate, u, convex, residual, space, rod)
        add_inertia(residual, s, v, v_n, rate, body)
        hold_fixed(s, residual, fixed)
        if iteration > 5:  # slow without the unsymmetric part of the derivative
            expand(s, a)
            unsymmetric(v, rate, u, space, rod)
            hold_rows(a, fixed, 1.0)
            factor_general(a)
            solve_columns(a, residual.reshape(size, 1))
        else:
            solve_5(s, residual)
        update = 0.0
        for k in range(size):
            # written so that NaN counts as too large
            if not abs(residual[k]) <= update:
                update = abs(residual[k])
        if not update < 1e6:
            return -iteration - 1, update
        scale = 1.0 if update < largest else largest / update
        convex = rate > 0.0 and update > careful
        for k in range(size):
            x[k] -= scale * residual[k]
        if update < solver.tolerance:
            return iteration + 1, update
    return -limit, update


@kernel
def simulate(
    motion: tuple[Array, Array], place: Place, pressures: Array, begin: int, solver: Solver,
    record: Record, space: PlanarSpace, rod: PlanarRod
) -> tuple[int, int, float, int]:  # fmt: skip
    """Run K intervals of S steps under pressures (K, S, M) from step `begin` on.

    `place` holds the state before that step, and in the end the state after the last step or
    before the one that failed. `motion`, q and v (K+1, 2n), receives the state after each interval,
    the record the linearisation of the solves unless it is empty.

    Returns (index of the failed step or K·S, Newton iterations, last update, iterations of the
    failed solve or 0).
    """
    intervals, steps, _ = pressures.shape
    q, v = motion
    x_n, v_n = place.x, place.v
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
        for stage in range(stages):
            predict(x, x_n, v_n, acceleration, solver.h, rod.body.fixed, far, False)
            iterations, update = newton(x, x_n, v_n, rate, u, solver, space, rod)
            if iterations < 0:  # the guess may have been at fault: once more from rest
                put(x_n, x)
                iterations, update = newton(x, x_n, v_n, rate, u, solver, space, rod)
            if iterations < 0:
                put(space.x_start, x_n)
                put(space.v_start, v_n)
                return index, total - iterations, update, -iterations
            total += iterations
            if record.factors.shape[0] > 0:
                slot = (index - begin) * stages + stage
                linearise(x, x_n, rate, u, record.inputs[slot], space, rod)
                keep(slot, space, record)
            go_on(x, x_n, v_n, acceleration, rate, solver.extrapolate[stage])
        if step == steps - 1:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
    return intervals * steps, total, 0.0, 0


@kernel
def linearise(
    x: Array, x_n: Array, rate: float, u: Array, columns: Array, space: PlanarSpace,
    rod: PlanarRod
) -> None:  # fmt: skip
    """Fill space.a with the exact derivative J of a solve's residual at x, columns with B(q)Λ.

    space.drag receives the part by −x_n that is not inertia. Fixed unknowns have unit rows in J.
    """
    v, s, body, fixed = space.v, space.s, rod.body, rod.body.fixed
    for k in range(x.shape[0]):
        v[k] = (x[k] - x_n[k]) * rate
    assemble(x, v, rate, u, rate < 0.0, space.residual, space, rod)
    for k in range(x.shape[0]):
        s[k, 0] += rate * (body.mass[k] * rate + body.damping[k])
    expand(s, space.a)
    unsymmetric(v, rate, u, space, rod)
    hold_rows(space.a, fixed, 1.0)
    hold_rows(space.drag, fixed, 0.0)
    input_columns(space.edge, 2, rod, columns)
    for d in fixed:
        for m in range(columns.shape[1]):
            columns[d, m] = 0.0
