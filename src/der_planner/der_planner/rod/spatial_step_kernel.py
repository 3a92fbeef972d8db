"""Compiled time steps of a rod in space; see `spatial_kernel` for the symbols and the rod's arrays.

Every kernel takes, after its own arguments: base, the reference frames at x_n as tangents,
directors (n-1, 3) and twists (n,); space, the work arrays (n,), (6, 4n-1), (4n-1, 11), (n-1, 13),
(n-1, 4, 5), (n, 4, 4), (12, 8), (10, 3), (4n-1, 21); body, the tuple of mass, damping, load (4n-1,)
and of the fixed indices; rod.
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
    solve_10,
    solve_one,
)
from der_planner.rod.compile import kernel
from der_planner.rod.spatial_assembly_kernel import assemble, unsymmetric
from der_planner.rod.spatial_kernel import D1, T, frames, reference_twists
from der_planner.rod.state import Array, Arrays
from der_planner.rod.step_kernel import add_inertia, go_on, predict


@kernel
def carry(x: Array, base: Arrays, space: Arrays) -> None:
    """Move the reference frames to x: the arrays of base are replaced."""
    tangents, directors, twists_n = base
    twists, frame = space[0], space[3]
    frames(x, tangents, directors, frame)
    reference_twists(frame, twists_n, twists)
    for j in range(frame.shape[0]):
        for k in range(3):
            tangents[j, k] = frame[j, T + k]
            directors[j, k] = frame[j, D1 + k]
        twists_n[j] = twists[j]


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
    x: Array, x_n: Array, v_n: Array, rate: float, u: Array, tolerance: float, lever: float,
    limit: int, base: Arrays, space: Arrays, body: Arrays, rod: Arrays,
) -> tuple[int, float]:  # fmt: skip
    """Solve M·rate·((x − x_n)·rate − v_n) + D·rate·(x − x_n) = F(x) for x, from the guess in x.

    rate = 0 is statics, where the reference frames follow each iterate. Returns (iterations, size
    of the last update); iterations is negative without convergence. The update is a length: an
    angle counts times lever [m].
    """
    twists, work, s, frame, own, link, local, vectors, a = space
    fixed = body[3]
    size = x.shape[0]
    residual, v = work[0], work[1]
    largest, careful = 2.0 * smallest(rod[0]), 0.1 * smallest(rod[0])
    update = np.inf
    convex = rate < 0.0
    for iteration in range(limit):
        for k in range(size):
            v[k] = (x[k] - x_n[k]) * rate
        frames(x, base[0], base[1], frame)
        reference_twists(frame, base[2], twists)
        assemble(x, v, rate, u, convex, residual, s, frame, twists, own, link, local, vectors, rod)
        add_inertia(residual, s, v, v_n, rate, body)
        # Inertia makes the symmetric part of the derivative good enough; rest does not.
        if rate == 0.0 or iteration > 5:
            expand(s, a)
            unsymmetric(frame, u, own, rod, a)
            hold_fixed(s, residual, fixed)
            hold_fixed_general(a, fixed)
            factor_general(a)
            solve_one(a, residual)
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
            carry(x, base, space)
        if update < tolerance:
            return iteration + 1, update
    return -limit, update


@kernel
def simulate(
    q: Array, v: Array, pressures: Array, h: float, extrapolate: Array, tolerance: float,
    lever: float, limit: int, base: Arrays, space: Arrays, body: Arrays, rod: Arrays,
) -> tuple[int, int, float, int]:  # fmt: skip
    """Run K intervals of S steps from q[0], v[0] into q, v (K+1, 4n-1); as for a planar rod.

    The reference frames in base are replaced by those of the last state.
    Returns (steps done, Newton iterations, last update, iterations of the failed step or 0).
    """
    intervals, steps, _ = pressures.shape
    work = space[1]
    x, x_n, v_n, acceleration = work[2], work[3], work[4], work[5]
    put(q[0], x_n)
    put(v[0], v_n)
    acceleration[:] = 0.0
    rate, far = 1.0 / h, 0.5 * smallest(rod[0])
    total = 0
    for index in range(intervals * steps):
        k, step = index // steps, index % steps
        u = pressures[k, step]
        predict(x, x_n, v_n, acceleration, h, body[3], far, True)
        iterations = -1
        update = np.inf
        for attempt in range(2):
            if attempt == 1:  # the guess may have been at fault: once more from rest
                put(x_n, x)
            iterations, update = newton(
                x, x_n, v_n, rate, u, tolerance, lever, limit, base, space, body, rod
            )
            if iterations > 0:
                break
        if iterations < 0:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
            return index, total - iterations, update, -iterations
        total += iterations
        e = extrapolate[index % extrapolate.shape[0]]
        go_on(x, x_n, v_n, acceleration, rate, e)
        carry(x_n, base, space)
        if step == steps - 1:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
    return intervals * steps, total, 0.0, 0
