"""Compiled time steps of a rod in space; see `elastic_kernel` for the symbols."""

from __future__ import annotations

import numpy as np

from der_planner.rod.banded_kernel import (
    expand,
    factor_general,
    hold_fixed,
    hold_rows,
    put,
    smallest,
    solve_10,
    solve_one,
)
from der_planner.rod.compile import kernel
from der_planner.rod.spatial.assembly_kernel import assemble, unsymmetric
from der_planner.rod.spatial.elastic_kernel import (
    D1,
    Base,
    SpatialRod,
    SpatialSpace,
    T,
    frames,
    reference_twists,
)
from der_planner.rod.spatial.linearisation_kernel import gauge_of_step, linearise
from der_planner.rod.state import Array
from der_planner.rod.step_kernel import (
    Body,
    Record,
    Solver,
    add_inertia,
    go_on,
    predict,
)


@kernel
def carry(x: Array, base: Base, space: SpatialSpace) -> None:
    """Move the reference frames to x: the arrays of base are replaced."""
    twists, frame = space.twists, space.frame
    frames(x, base, frame)
    reference_twists(frame, base.twists, twists)
    for j in range(frame.shape[0]):
        for k in range(3):
            base.tangents[j, k] = frame[j, T + k]
            base.directors[j, k] = frame[j, D1 + k]
        base.twists[j] = twists[j]


@kernel
def save_base(base: Base, saved: Array) -> None:
    """Copy the frames into saved (n, 7)."""
    for j in range(base.tangents.shape[0]):
        for k in range(3):
            saved[j, k] = base.tangents[j, k]
            saved[j, 3 + k] = base.directors[j, k]
        saved[j, 6] = base.twists[j]


@kernel
def load_base(saved: Array, base: Base) -> None:
    """Copy saved (n, 7) back into the frames."""
    for j in range(base.tangents.shape[0]):
        for k in range(3):
            base.tangents[j, k] = saved[j, k]
            base.directors[j, k] = saved[j, 3 + k]
        base.twists[j] = saved[j, 6]


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
    x: Array, x_n: Array, v_n: Array, rate: float, u: Array, solver: Solver, base: Base,
    space: SpatialSpace, body: Body, rod: SpatialRod,
) -> tuple[int, float]:  # fmt: skip
    """Solve M rate ((x − x_n) rate − v_n) + D rate (x − x_n) = F(x) for x, from the guess in x.

    rate = 0 is statics, where the reference frames follow each iterate. Returns (iterations, size
    of the last update); iterations is negative without convergence. The update is a length: an
    angle counts times solver.lever [m].
    """
    residual, v, s, a = space.residual, space.v, space.s, space.a
    fixed, limit, lever = body.fixed, solver.limit, solver.lever
    size = x.shape[0]
    largest, careful = 2.0 * smallest(rod.rest), 0.1 * smallest(rod.rest)
    update = np.inf
    convex = rate < 0.0
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
        if update < solver.tolerance:
            return iteration + 1, update
    return -limit, update


@kernel
def simulate(
    q: Array, v: Array, x_n: Array, v_n: Array, base: Base, pressures: Array, begin: int,
    solver: Solver, record: Record, space: SpatialSpace, body: Body, rod: SpatialRod,
) -> tuple[int, int, float, int]:  # fmt: skip
    """Run K intervals of S steps under pressures (K, S, M) from step `begin` on.

    x_n, v_n (4n-1,) and base hold the state before that step, and in the end the state after the
    last step or before the one that failed. q, v (K+1, 4n-1) receive the state after each interval,
    the record the linearisation of the solves unless it is empty.

    Returns (index of the failed step or K·S, Newton iterations, last update, iterations of the
    failed solve or 0).
    """
    intervals, steps, _ = pressures.shape
    x, acceleration = space.x, space.acceleration
    acceleration[:] = 0.0
    stages = solver.extrapolate.shape[0]
    rate, far = 1.0 / solver.h, 0.5 * smallest(rod.rest)
    total = 0
    for index in range(begin, intervals * steps):
        k, step = index // steps, index % steps
        u = pressures[k, step]
        put(x_n, space.x_start)
        put(v_n, space.v_start)
        save_base(base, space.base_start)
        for stage in range(stages):
            predict(x, x_n, v_n, acceleration, solver.h, body.fixed, far, True)
            iterations = -1
            update = np.inf
            for attempt in range(2):
                if attempt == 1:  # the guess may have been at fault: once more from rest
                    put(x_n, x)
                iterations, update = newton(x, x_n, v_n, rate, u, solver, base, space, body, rod)
                if iterations > 0:
                    break
            if iterations < 0:
                put(space.x_start, x_n)
                put(space.v_start, v_n)
                load_base(space.base_start, base)
                return index, total - iterations, update, -iterations
            total += iterations
            extrapolate = solver.extrapolate[stage]
            if record.factors.shape[0] > 0:
                slot = (index - begin) * stages + stage
                keep(slot, x, x_n, base, rate, extrapolate, u, record, space, body, rod)
            go_on(x, x_n, v_n, acceleration, rate, extrapolate)
            carry(x_n, base, space)
        if step == steps - 1:
            put(x_n, q[k + 1])
            put(v_n, v[k + 1])
    return intervals * steps, total, 0.0, 0


@kernel
def keep(
    slot: int, x: Array, x_n: Array, base: Base, rate: float, extrapolate: float,
    u: Array, record: Record, space: SpatialSpace, body: Body, rod: SpatialRod,
) -> None:  # fmt: skip
    """Write the exact linearisation of the solve that led from x_n to x into the record."""
    linearise(x, x_n, rate, u, base, record.back[slot], record.inputs[slot], space, body, rod)
    factor_general(space.a)
    for d in range(x.shape[0]):
        put(space.a[d], record.factors[slot, d])
    gauge_of_step(x, x_n, extrapolate, record.gauge[slot], space)
