"""Compiled sweeps over the recorded linearisation of a simulation, for any half-bandwidth.

One solve is J y = (M rate² + D rate) δq + M rate δv + `back` δq + `inputs` δu (see `Record`), then
δq' = δq + e (y − δq) and δv' = δv + e (rate (y − δq) − δv); in space the angles then turn by
`gauge`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod.banded_kernel import (
    add_product,
    add_transposed_product,
    put,
    solve_columns,
    solve_transposed,
)
from der_planner.rod.compile import allocating_kernel, kernel
from der_planner.rod.step_kernel import Record


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
    """Write the outputs of the first column of dq into out (P,)."""
    for p in range(outputs.shape[0]):
        out[p] = dq[outputs[p], 0]


@kernel
def ends_interval(solve: int, steps: int, chain: SolveChain) -> bool:
    """Return whether this is the last solve of an interval of so many steps."""
    if solve + 1 == chain.steps.shape[0]:
        return True
    return bool(chain.steps[solve + 1] // steps > chain.steps[solve] // steps)


@allocating_kernel
def tangent(change: Array, start: Array, chain: SolveChain, out: Array) -> None:
    """Fill out (K+1, P) with the change of the outputs for a change (K, S, M) of the inputs.

    start (2, n) is the change of the initial q and v.
    """
    _, steps, count = change.shape
    size = start.shape[1]
    dq = start[0].copy().reshape(size, 1)
    dv = start[1].copy().reshape(size, 1)
    y = np.zeros((size, 1))
    before = np.zeros((size, 1))
    put_outputs(dq, chain.outputs, out[0])
    for s in range(chain.steps.shape[0]):
        k, step = chain.steps[s] // steps, chain.steps[s] % steps
        for i in range(size):
            total = 0.0
            for m in range(count):
                total += chain.record.inputs[s, i, m] * change[k, step, m]
            y[i, 0] = total
        advance(s, dq, dv, y, before, chain)
        if ends_interval(s, steps, chain):
            put_outputs(dq, chain.outputs, out[k + 1])


@allocating_kernel
def adjoint(weight: Array, chain: SolveChain, gradient: Array, start: Array) -> None:
    """Fill gradient (K, S, M) and start (2, n): `tangent` transposed, times weight (K+1, P)."""
    _, steps, count = gradient.shape
    record = chain.record
    size = start.shape[1]
    lq = np.zeros(size)
    lv = np.zeros(size)
    y = np.zeros(size)
    before = np.zeros(size)
    gradient[:] = 0.0
    for s in range(chain.steps.shape[0] - 1, -1, -1):
        k, step = chain.steps[s] // steps, chain.steps[s] % steps
        if ends_interval(s, steps, chain):
            for p in range(chain.outputs.shape[0]):
                lq[chain.outputs[p]] += weight[k + 1, p]
        e, rate = chain.extrapolate[s], chain.rates[s]
        before[:] = 0.0
        if record.gauge.shape[0] > 0:
            gauge_transposed(record.gauge[s], lq, before)
        for i in range(size):
            y[i] = e * (lq[i] + rate * lv[i])
        solve_transposed(record.factors[s], y)
        for m in range(count):
            total = 0.0
            for i in range(size):
                total += record.inputs[s, i, m] * y[i]
            gradient[k, step, m] += total
        for i in range(size):
            momentum = chain.mass[i] * rate
            inertia = (momentum + chain.damping[i]) * rate
            lq[i] = (1.0 - e) * lq[i] - e * rate * lv[i] + inertia * y[i] + before[i]
            lv[i] = (1.0 - e) * lv[i] + momentum * y[i]
        if record.back.shape[0] > 0:
            add_transposed_product(record.back[s], y, lq)
    for p in range(chain.outputs.shape[0]):
        lq[chain.outputs[p]] += weight[0, p]
    put(lq, start[0])
    put(lv, start[1])


@kernel
def gauge_transposed(gauge: Array, lq: Array, before: Array) -> None:
    """Carry lq (n,) back through the turning of the angles; before (n,) receives δe's share."""
    for j in range(gauge.shape[0]):
        weight = lq[4 * j + 3]
        for k in range(3):
            here, there = 4 * j + k, 4 * j + 4 + k
            lq[there] += gauge[j, k] * weight
            lq[here] -= gauge[j, k] * weight
            before[there] += gauge[j, 3 + k] * weight
            before[here] -= gauge[j, 3 + k] * weight


@allocating_kernel
def sensitivity(
    pulse: Array, intervals: int, steps: int, chunk: int, chain: SolveChain, out: Array
) -> None:
    """Fill out (K+1, P, K, M): each output's change by a unit pulse of each input.

    pulse (R, M) is the pressure of the steps that follow the start of an interval. `chunk`
    intervals are propagated together, so that their columns stay in the nearest cache and fill the
    vector unit.
    """
    inputs, outputs = chain.record.inputs, chain.outputs
    count = inputs.shape[2]
    size = inputs.shape[1]
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
                for p in range(outputs.shape[0]):
                    for c in range(columns):
                        out[k + 1, p, begin + c // count, c % count] = dq[outputs[p], c]
