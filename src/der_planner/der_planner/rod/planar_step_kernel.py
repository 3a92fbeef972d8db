"""Compiled time steps of a planar rod; see `planar_kernel` for the symbols and the rod's arrays.

Every kernel takes, after its own arguments: space, work arrays (6, 2n), (2n, 6), (2n, 6), (n-1, 3),
(n,), (n, 2), (2, 6), (2n, 11); body, the tuple of mass, damping, load (2n,) and of the fixed
indices; rod.
"""

from __future__ import annotations

import numpy as np

from der_planner.rod.band_kernel import (
    expand,
    factor_general,
    hold_fixed,
    hold_fixed_general,
    put,
    smallest,
    solve_5,
    solve_one,
)
from der_planner.rod.compile import kernel
from der_planner.rod.planar_kernel import assemble, input_columns, unsymmetric
from der_planner.rod.state import Array, Arrays
from der_planner.rod.step_kernel import add_inertia, go_on, predict


@kernel
def newton(
    x: Array, x_n: Array, v_n: Array, rate: float, u: Array, tolerance: float, limit: int,
    space: Arrays, body: Arrays, rod: Arrays,
) -> tuple[int, float]:  # fmt: skip
    """Solve M·rate·((x − x_n)·rate − v_n) + D·rate·(x − x_n) = F(x) for x, from the guess in x.

    rate = 0 is statics. Returns (iterations, size of the last update [m]); iterations is negative
    without convergence.
    """
    work, s, band, edge, turn, torque, parts, a = space
    fixed = body[3]
    size = x.shape[0]
    residual, v = work[0], work[1]
    largest, careful = 2.0 * smallest(rod[0]), 0.1 * smallest(rod[0])
    update = np.inf
    convex = rate < 0.0
    for iteration in range(limit):
        for k in range(size):
            v[k] = (x[k] - x_n[k]) * rate
        assemble(x, v, rate, u, convex, residual, s, edge, turn, torque, rod)
        add_inertia(residual, s, v, v_n, rate, body)
        hold_fixed(s, residual, fixed)
        if iteration > 5:  # slow without the unsymmetric part of the derivative
            expand(s, a)
            unsymmetric(v, rate, u, a, band, edge, turn, parts, rod)
            hold_fixed_general(a, fixed)
            factor_general(a)
            solve_one(a, residual)
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
        if update < tolerance:
            return iteration + 1, update
    return -limit, update


@kernel
def simulate(
    q: Array, v: Array, pressures: Array, h: float, extrapolate: Array, tolerance: float,
    limit: int, factors: Array, viscous: Array, inputs: Array, stages: Array,
    space: Arrays, body: Arrays, rod: Arrays,
) -> tuple[int, int, float, int]:  # fmt: skip
    """Run K intervals of S steps from q[0], v[0] into q, v (K+1, 2n).

    Each step solves backward Euler over h and goes on to x_n + e (x − x_n) with e =
    extrapolate[step modulo its length] (P,). pressures is (K, S, M). factors (K·S, 2n, 11), viscous
    (K·S or 0, 2n, 6) and inputs (K·S, 2n, M) receive the linearisation unless empty, stages (K·S,
    3, 2n) each solution's position, velocity and acceleration.

    Returns (steps done, Newton iterations, last update, iterations of the failed step or 0).
    """
    intervals, steps, _ = pressures.shape
    size = q.shape[1]
    work, band = space[0], space[2]
    x, x_n, v_n, acceleration = work[2], work[3], work[4], work[5]
    put(q[0], x_n)
    put(v[0], v_n)
    acceleration[:] = 0.0
    rate, far = 1.0 / h, 0.5 * smallest(rod[0])
    total = 0
    for index in range(intervals * steps):
        k, step = index // steps, index % steps
        u = pressures[k, step]
        predict(x, x_n, v_n, acceleration, h, body[3], far, False)
        iterations = -1
        update = np.inf
        for attempt in range(2):
            if attempt == 1:  # the guess may have been at fault: once more from rest
                put(x_n, x)
            iterations, update = newton(x, x_n, v_n, rate, u, tolerance, limit, space, body, rod)
            if iterations > 0:
                break
        if iterations < 0:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
            return index, total - iterations, update, -iterations
        total += iterations
        if factors.shape[0] > 0:
            linearise(x, x_n, rate, u, factors[index], inputs[index], space, body, rod)
            factor_general(factors[index])
            for d in range(size):
                velocity = (x[d] - x_n[d]) * rate
                stages[index, 0, d] = x[d]
                stages[index, 1, d] = velocity
                stages[index, 2, d] = (velocity - v_n[d]) * rate
            if viscous.shape[0] > 0:
                for d in range(size):
                    put(band[d], viscous[index, d])
        e = extrapolate[index % extrapolate.shape[0]]
        go_on(x, x_n, v_n, acceleration, rate, e)
        if step == steps - 1:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
    return intervals * steps, total, 0.0, 0


@kernel
def residual_changes(
    stages: Array, pressures: Array, rate: float, space: Arrays, body: Arrays, rod: Arrays,
    other_body: Arrays, other_rod: Arrays, out: Array,
) -> None:  # fmt: skip
    """Fill out (steps, 2n) with this rod's residual minus another's at stored solutions."""
    work, s, _, edge, turn, torque, _, _ = space
    for index in range(stages.shape[0]):
        x, v, acceleration = stages[index, 0], stages[index, 1], stages[index, 2]
        u = pressures[index]
        assemble(x, v, rate, u, rate < 0.0, work[0], s, edge, turn, torque, rod)
        assemble(x, v, rate, u, rate < 0.0, work[1], s, edge, turn, torque, other_rod)
        for d in range(out.shape[1]):
            change = work[0, d] - work[1, d]
            change += (body[0][d] - other_body[0][d]) * acceleration[d]
            change += (body[1][d] - other_body[1][d]) * v[d]
            out[index, d] = change - (body[2][d] - other_body[2][d])
        for d in body[3]:
            out[index, d] = 0.0


@kernel
def linearise(
    x: Array, x_n: Array, rate: float, u: Array, a: Array, columns: Array,
    space: Arrays, body: Arrays, rod: Arrays,
) -> None:  # fmt: skip
    """Fill a (2n, 11) with the exact derivative of the step's residual at x, columns with B(q)Λ.

    The third work array receives the viscous matrix times rate. Fixed unknowns have unit rows.
    """
    work, s, band, edge, turn, torque, parts, _ = space
    mass, damping, _, fixed = body
    size = x.shape[0]
    v = work[1]
    for k in range(size):
        v[k] = (x[k] - x_n[k]) * rate
    assemble(x, v, rate, u, rate < 0.0, work[0], s, edge, turn, torque, rod)
    for k in range(size):
        s[k, 0] += rate * (mass[k] * rate + damping[k])
    expand(s, a)
    unsymmetric(v, rate, u, a, band, edge, turn, parts, rod)
    hold_fixed_general(a, fixed)
    hold_fixed(band, work[0], fixed)
    for d in fixed:
        band[d, 0] = 0.0
    input_columns(edge, rod, columns)
    for d in fixed:
        for m in range(columns.shape[1]):
            columns[d, m] = 0.0
