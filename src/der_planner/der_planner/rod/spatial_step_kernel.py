"""Compiled time steps of a rod in space; see `spatial_kernel` for the symbols and the rod's arrays."""

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
from der_planner.rod.spatial_kernel import D1, T, assemble, frames, reference_twists, unsymmetric


@kernel
def carry(x, twists_n, tangents, directors, twists, frame):
    """Move the reference frames to x: tangents, directors and twists_n are replaced."""
    frames(x, tangents, directors, frame)
    reference_twists(frame, twists_n, twists)
    for j in range(frame.shape[0]):
        for k in range(3):
            tangents[j, k] = frame[j, T + k]
            directors[j, k] = frame[j, D1 + k]
        twists_n[j] = twists[j]


@kernel
def newton(
    x, x_n, v_n, rate, u, tolerance, lever, limit, tangents, directors, twists_n, twists,
    work, s, frame, own, link, local, vectors, a, mass, damping, load, fixed,
    rest, axial, bend, twist, cubic, viscous, rest_kappa, rest_twist, first, last, gain,
):  # fmt: skip
    """Solve M·rate·((x − x_n)·rate − v_n) + D·rate·(x − x_n) = F(x) for x, from the guess in x.

    rate = 0 is statics, where the reference frames follow each iterate. tangents, directors (n-1, 3) and twists_n (n,) are the reference frames at x_n.
    Returns (iterations, size of the last update); iterations is negative without convergence. The
    update is a length: an angle counts times lever [m].
    """
    size = x.shape[0]
    residual = work[0]
    v = work[1]
    shortest = smallest(rest)
    largest, careful = 2.0 * shortest, 0.1 * shortest
    update = np.inf
    convex = rate < 0.0
    for iteration in range(limit):
        for k in range(size):
            v[k] = (x[k] - x_n[k]) * rate
        frames(x, tangents, directors, frame)
        reference_twists(frame, twists_n, twists)
        assemble(x, v, rate, u, convex, residual, s, frame, twists, own, link, local, vectors,
                 rest, axial, bend, twist, cubic, viscous, rest_kappa, rest_twist,
                 first, last, gain)  # fmt: skip
        for k in range(size):
            residual[k] += mass[k] * rate * (v[k] - v_n[k]) + damping[k] * v[k] - load[k]
            s[k, 0] += rate * (mass[k] * rate + damping[k])
        # Inertia makes the symmetric part of the derivative good enough; rest does not.
        if rate == 0.0 or iteration > 5:
            expand(s, a)
            unsymmetric(frame, u, own, first, last, gain, a)
            hold_fixed(s, residual, fixed)
            hold_fixed_general(a, fixed)
            factor_general(a)
            solve_one(a, residual)
        else:
            hold_fixed(s, residual, fixed)
            solve_10(s, residual)
        update = 0.0
        turn = 0.0
        for k in range(size):
            # written so that NaN counts as too large
            change = abs(residual[k])
            if k % 4 == 3:
                if not change <= turn:
                    turn = change
            elif not change <= update:
                update = change
        if not max(update, turn) < 1e6:
            return -iteration - 1, update
        scale = min(1.0, largest / max(update, largest), 0.7 / max(turn, 0.7))
        convex = rate > 0.0 and update > careful
        update = max(update, lever * turn)
        for k in range(size):
            x[k] -= scale * residual[k]
        if rate == 0.0:
            # Far from their base the frames' holonomy, which the symmetric derivative leaves out, would
            # slow the iteration down; at rest nothing depends on when the frames were carried along.
            carry(x, twists_n, tangents, directors, twists, frame)
        if update < tolerance:
            return iteration + 1, update
    return -limit, update


@kernel
def simulate(
    q, v, pressures, h, extrapolate, tolerance, lever, limit, tangents, directors, twists_n,
    twists, work, s, frame, own, link, local, vectors, a,
    mass, damping, load, fixed,
    rest, axial, bend, twist, cubic, viscous, rest_kappa, rest_twist, first, last, gain,
):  # fmt: skip
    """Run K intervals of S steps from q[0], v[0] into q, v (K+1, 4n-1); as `planar_kernel.simulate`.

    The reference frames are replaced by those of the last state.
    Returns (steps done, Newton iterations, last update, iterations of the failed step or 0).
    """
    intervals, steps, _ = pressures.shape
    size = q.shape[1]
    x, x_n, v_n, acceleration = work[2], work[3], work[4], work[5]
    put(q[0], x_n)
    put(v[0], v_n)
    acceleration[:] = 0.0
    rate = 1.0 / h
    total = 0
    far = 0.5 * smallest(rest)
    for k in range(intervals):
        for step in range(steps):
            u = pressures[k, step]
            quiet = True
            for d in range(size):
                move = h * (v_n[d] + h * acceleration[d])
                x[d] = x_n[d] + move
                quiet = quiet and abs(move) < (0.5 if d % 4 == 3 else far)
            if not quiet:
                put(x_n, x)
            for d in fixed:
                x[d] = x_n[d]
            iterations = -1
            update = np.inf
            for attempt in range(2):
                if attempt == 1:  # the guess may have been at fault: once more from rest
                    put(x_n, x)
                iterations, update = newton(
                    x, x_n, v_n, rate, u, tolerance, lever, limit, tangents, directors, twists_n, twists,
                    work, s, frame, own, link, local, vectors, a, mass, damping, load, fixed,
                    rest, axial, bend, twist, cubic, viscous, rest_kappa, rest_twist,
                    first, last, gain)  # fmt: skip
                if iterations > 0:
                    break
            index = k * steps + step
            if iterations < 0:
                put(x_n, q[k + 1])
                put(v_n, v[k + 1])
                return index, total - iterations, update, -iterations
            total += iterations
            e = extrapolate[index % extrapolate.shape[0]]
            for d in range(size):
                velocity = (x[d] - x_n[d]) * rate
                acceleration[d] = (velocity - v_n[d]) * rate
                x_n[d] += e * (x[d] - x_n[d])
                v_n[d] += e * (velocity - v_n[d])
            carry(x_n, twists_n, tangents, directors, twists, frame)
        put(x_n, q[k + 1])
        put(v_n, v[k + 1])
    return intervals * steps, total, 0.0, 0
