"""Compiled pieces of a time step that rods in a plane and in space share.

A step is a chain of solves. One solve is a backward Euler step over h = 1/rate:

    M rate (v − v_n) + D v = F(x),    v = rate (x − x_n),

after which the state goes on to (x_n, v_n) + e ((x, v) − (x_n, v_n)): e = 1 is backward Euler, e
= 2 over half a step the implicit midpoint rule, and γ, then 1, Alexander's SDIRK (Alexander,
"Diagonally implicit Runge-Kutta methods for stiff O.D.E.'s", SIAM J. Numer. Anal. 14, 1977).

The sweeps over the recorded linearisation of a simulation serve any half-bandwidth. One solve is
J y = (M rate² + D rate) δq + M rate δv + `back` δq + `inputs` δu (see `Record`), then
δq' = δq + e (y − δq) and δv' = δv + e (rate (y − δq) − δv); in space the angles then turn by
`gauge`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod.banded_kernel import add_product, factor_general, put, solve_columns
from der_planner.rod.compile import allocating_kernel, inlined_kernel, kernel


class Body(NamedTuple):
    """What moves: for the n kernel unknowns."""

    mass: Array  # (n,) [kg, kg·m²]
    damping: Array  # (n,) D [kg/s, kg·m²/s]
    load: Array  # (n,) gravity and point forces [N]
    fixed: NDArray[np.int64]  # indices of the unknowns that do not move


class Base(NamedTuple):
    """The reference frames of the state from which a step begins; empty for a planar rod."""

    tangents: Array  # (n-1, 3) t̂
    directors: Array  # (n-1, 3) d̂
    twists: Array  # (n,) reference twist [rad]


class Place(NamedTuple):
    """Where a run is, in the kernels' coordinates; the kernels move it on."""

    x: Array  # (unknowns,) positions [m] and angles [rad]
    v: Array  # (unknowns,) their rate
    base: Base


class Solver(NamedTuple):
    """How a step is solved."""

    h: float  # time over which each solve goes [s]
    extrapolate: Array  # (P,) e of each solve of a step
    tolerance: float  # largest last Newton update [m]
    lever: float  # an angle counts times this length as an update [m]
    limit: int  # most Newton iterations of a solve


class Record(NamedTuple):
    """The linearisation of each solve, b being the half-bandwidth; empty where it is not kept.

    One solve is J y = (M rate² + D rate) δq + M rate δv + `back` δq + `inputs` δu. In space the
    angle of edge j, counted in the frames of the state that the solve leads to, is then larger by
    gauge[j, :3]·δe' + gauge[j, 3:]·δe with the edge's change δe before and δe' after.
    """

    factors: Array  # (solves, n, 2b+1) J as L U
    back: Array  # (solves or 0, n, 2b+1)
    inputs: Array  # (solves, n, M) B(q)Λ [N/Pa]
    gauge: Array  # (solves or 0, n_edges, 6) [rad/m]


@kernel
def predict(
    x: Array, x_n: Array, v_n: Array, acceleration: Array, h: float, fixed: Array, far: float,
    angles: bool
) -> None:  # fmt: skip
    """Fill x with a guess of the solution: the last acceleration goes on, unless it leads far.

    far [m]; with `angles` every fourth unknown is one, for which 0.5 rad is far.
    """
    for d in range(x.shape[0]):
        move = h * (v_n[d] + h * acceleration[d])
        x[d] = x_n[d] + move
        if not abs(move) < (0.5 if angles and d % 4 == 3 else far):
            put(x_n, x)
            return
    for d in fixed:
        x[d] = x_n[d]


@inlined_kernel
def add_inertia(residual: Array, s: Array, v: Array, v_n: Array, rate: float, body: Body) -> None:
    """Add M rate (v − v_n) + D v − load to the residual, M rate² + D rate to its derivative s."""
    mass, damping, load = body.mass, body.damping, body.load
    for k in range(residual.shape[0]):
        residual[k] += mass[k] * rate * (v[k] - v_n[k]) + damping[k] * v[k] - load[k]
        s[k, 0] += rate * (mass[k] * rate + damping[k])


@kernel
def go_on(
    x: Array, x_n: Array, v_n: Array, acceleration: Array, rate: float, extrapolate: float
) -> None:
    """Move x_n, v_n to where a solve leads: `extrapolate` times the way to the solution x."""
    for d in range(x.shape[0]):
        velocity = (x[d] - x_n[d]) * rate
        acceleration[d] = (velocity - v_n[d]) * rate
        x_n[d] += extrapolate * (x[d] - x_n[d])
        v_n[d] += extrapolate * (velocity - v_n[d])


@kernel
def input_columns(edge: Array, per_node: int, rod: Any, columns: Array) -> None:
    """Fill columns (unknowns, M) with B(q)Λ of a rod with so many unknowns a node.

    At a segment's first edge −Λ ẑ×t on its first node and +Λ ẑ×t on the second, at its last edge
    the reverse: the two couples of the paper's Corollary 1. Each row of edge begins with t.
    """
    first, last, gain = rod.first, rod.last, rod.gain
    columns[:] = 0.0
    for m in range(gain.shape[0]):
        for end in range(2):
            j = first[m] if end == 0 else last[m]
            force = -gain[m] if end == 0 else gain[m]
            behind, ahead = per_node * j, per_node * (j + 1)
            columns[behind, m] += force * edge[j, 1]
            columns[behind + 1, m] -= force * edge[j, 0]
            columns[ahead, m] -= force * edge[j, 1]
            columns[ahead + 1, m] += force * edge[j, 0]


@kernel
def keep(slot: int, space: Any, record: Record) -> None:
    """Write a solve's linearisation, of which `space` has J and the part by −x_n, into the record.

    The columns of the inputs are there already.
    """
    factor_general(space.a)
    for d in range(space.a.shape[0]):
        put(space.a[d], record.factors[slot, d])
        if record.back.shape[0] > 0:
            put(space.drag[d], record.back[slot, d])


class SolveChain(NamedTuple):
    """The solves of a simulation in their order, and what of them is an output."""

    record: Record
    mass: Array  # (n,) 0 where fixed [kg, kg·m²]
    damping: Array  # (n,) 0 where fixed [kg/s, kg·m²/s]
    rates: Array  # (solves,) 1/h [1/s]
    extrapolate: Array  # (solves,) e
    steps: NDArray[np.int64]  # (solves,) index of the integrator step that each belongs to
    outputs: NDArray[np.int64]  # (P,) rows of the outputs


@kernel
def advance(solve: int, dq: Array, dv: Array, y: Array, before: Array, chain: SolveChain) -> None:
    """Advance the columns dq, dv (n, C) by one solve, given B δu in y (n, C).

    before (n, C) is work space, used in space.
    """
    record = chain.record
    rate, extrapolate = chain.rates[solve], chain.extrapolate[solve]
    size, columns = dq.shape
    for i in range(size):
        momentum = chain.mass[i] * rate
        inertia = (momentum + chain.damping[i]) * rate
        for c in range(columns):
            y[i, c] += inertia * dq[i, c] + momentum * dv[i, c]
    if record.back.shape[0] > 0:
        add_product(record.back[solve], dq, y)
    solve_columns(record.factors[solve], y)
    turning = record.gauge.shape[0] > 0
    if turning:
        for i in range(size):
            for c in range(columns):
                before[i, c] = dq[i, c]
    for i in range(size):
        for c in range(columns):
            move = y[i, c] - dq[i, c]
            dq[i, c] += extrapolate * move
            dv[i, c] += extrapolate * (rate * move - dv[i, c])
    if turning:
        gauge = record.gauge[solve]
        for j in range(gauge.shape[0]):
            for k in range(3):
                here, there = 4 * j + k, 4 * j + 4 + k
                after, earlier = gauge[j, k], gauge[j, 3 + k]
                for c in range(columns):
                    dq[4 * j + 3, c] += after * (dq[there, c] - dq[here, c])
                    dq[4 * j + 3, c] += earlier * (before[there, c] - before[here, c])


@kernel
def put_outputs(dq: Array, outputs: Array, out: Array) -> None:
    """Write the outputs of dq (n, C) into out (P, C)."""
    for p in range(outputs.shape[0]):
        for c in range(dq.shape[1]):
            out[p, c] = dq[outputs[p], c]


@kernel
def ends_interval(solve: int, steps: int, chain: SolveChain) -> bool:
    """Return whether this is the last solve of an interval of so many steps."""
    if solve + 1 == chain.steps.shape[0]:
        return True
    return bool(chain.steps[solve + 1] // steps > chain.steps[solve] // steps)


@allocating_kernel
def tangent(change: Array, start: Array, chain: SolveChain, out: Array) -> None:
    """Fill out (K+1, P, C) with changes of the outputs for changes (K, S, M, C) of the inputs.

    start (2, n, C) are the changes of the initial q and v.
    """
    _, steps, count, columns = change.shape
    size = start.shape[1]
    dq, dv = start[0].copy(), start[1].copy()
    y, before = np.zeros((size, columns)), np.zeros((size, columns))
    put_outputs(dq, chain.outputs, out[0])
    for s in range(chain.steps.shape[0]):
        k, step = chain.steps[s] // steps, chain.steps[s] % steps
        for i in range(size):
            for c in range(columns):
                total = 0.0
                for m in range(count):
                    total += chain.record.inputs[s, i, m] * change[k, step, m, c]
                y[i, c] = total
        advance(s, dq, dv, y, before, chain)
        if ends_interval(s, steps, chain):
            put_outputs(dq, chain.outputs, out[k + 1])


@allocating_kernel
def sensitivity(
    pulse: Array, intervals: int, steps: int, chunk: int, chain: SolveChain, out: Array
) -> None:
    """Fill out (K+1, P, K, M): each output's change by a unit pulse of each input.

    pulse (R, M) is the pressure of the steps that follow the start of an interval. `chunk`
    intervals are propagated together, so that their columns stay in the nearest cache and fill the
    vector unit.
    """
    inputs = chain.record.inputs
    _, size, count = inputs.shape
    solves = chain.steps.shape[0]
    for begin in range(0, intervals, chunk):
        end = min(intervals, begin + chunk)
        columns = (end - begin) * count
        dq = np.zeros((size, columns))
        dv = np.zeros((size, columns))
        y = np.zeros((size, columns))
        before = np.zeros((size, columns))
        for s in range(np.searchsorted(chain.steps, begin * steps), solves):
            k = chain.steps[s] // steps
            y[:] = 0.0
            for j in range(begin, min(end, k + 1)):
                since = chain.steps[s] - j * steps
                if since < pulse.shape[0]:
                    for m in range(count):
                        size_of_pulse = pulse[since, m]
                        for i in range(size):
                            y[i, (j - begin) * count + m] = inputs[s, i, m] * size_of_pulse
            advance(s, dq, dv, y, before, chain)
            if ends_interval(s, steps, chain):
                put_outputs(dq, chain.outputs, out[k + 1, :, begin * count : end * count])
