"""Compiled sweeps over the stored linearisation of a simulation, for any half-bandwidth.

One step is J y = (M·rate² + D·rate + V) δq + M·rate δv + B δu, then δq' = δq + e (y − δq) and
δv' = δv + e (rate (y − δq) − δv), e = extrapolate[step modulo its length] (P,). `inertia` and
`momentum` hold the two diagonals (zero where fixed), V is the viscous band, J is stored factored.
"""

from __future__ import annotations

import numpy as np

from der_planner.rod.band_kernel import put, solve_columns, solve_transposed
from der_planner.rod.compile import kernel
from der_planner.rod.state import Array


@kernel
def advance(
    dq: Array,
    dv: Array,
    y: Array,
    factors: Array,
    viscous: Array,
    inertia: Array,
    momentum: Array,
    rate: float,
    extrapolate: float,
) -> None:
    """Advance the columns dq, dv (n, C) by one step, given B δu in y (n, C)."""
    size, columns = dq.shape
    for i in range(size):
        a = inertia[i]
        b = momentum[i]
        for c in range(columns):
            y[i, c] += a * dq[i, c] + b * dv[i, c]
    if viscous.shape[0] > 0:
        width = viscous.shape[1]
        for i in range(size):
            for k in range(min(width, size - i)):
                a = viscous[i, k]
                if a != 0.0:
                    for c in range(columns):
                        y[i + k, c] += a * dq[i, c]
                    if k > 0:
                        for c in range(columns):
                            y[i, c] += a * dq[i + k, c]
    solve_columns(factors, y)
    for i in range(size):
        for c in range(columns):
            move = y[i, c] - dq[i, c]
            dq[i, c] += extrapolate * move
            dv[i, c] += extrapolate * (rate * move - dv[i, c])


@kernel
def tangent(
    change: Array,
    start: Array,
    factors: Array,
    viscous: Array,
    inputs: Array,
    inertia: Array,
    momentum: Array,
    rate: float,
    extrapolate: Array,
    outputs: Array,
    out: Array,
) -> None:
    """Fill out (K+1, P) with the change of the outputs for a change (K, S, M) of the inputs.

    start (2, n) is the change of the initial q and v.
    """
    intervals, steps, count = change.shape
    size = start.shape[1]
    dq = start[0].copy().reshape(size, 1)
    dv = start[1].copy().reshape(size, 1)
    y = np.zeros((size, 1))
    for p in range(outputs.shape[0]):
        out[0, p] = dq[outputs[p], 0]
    for k in range(intervals):
        for step in range(steps):
            s = k * steps + step
            for i in range(size):
                total = 0.0
                for m in range(count):
                    total += inputs[s, i, m] * change[k, step, m]
                y[i, 0] = total
            band = viscous[s] if viscous.shape[0] > 0 else viscous[:0].reshape(0, 1)
            advance(dq, dv, y, factors[s], band, inertia, momentum, rate,
                    extrapolate[s % extrapolate.shape[0]])  # fmt: skip
        for p in range(outputs.shape[0]):
            out[k + 1, p] = dq[outputs[p], 0]


@kernel
def adjoint(
    weight: Array,
    factors: Array,
    viscous: Array,
    inputs: Array,
    inertia: Array,
    momentum: Array,
    rate: float,
    extrapolate: Array,
    outputs: Array,
    gradient: Array,
    start: Array,
) -> None:
    """Fill gradient (K, S, M) and start (2, n): `tangent` transposed, times weight (K+1, P)."""
    intervals, steps, count = gradient.shape
    size = start.shape[1]
    lq = np.zeros(size)
    lv = np.zeros(size)
    y = np.zeros(size)
    for k in range(intervals - 1, -1, -1):
        for p in range(outputs.shape[0]):
            lq[outputs[p]] += weight[k + 1, p]
        for step in range(steps - 1, -1, -1):
            s = k * steps + step
            e = extrapolate[s % extrapolate.shape[0]]
            for i in range(size):
                y[i] = e * (lq[i] + rate * lv[i])
            solve_transposed(factors[s], y)
            for m in range(count):
                total = 0.0
                for i in range(size):
                    total += inputs[s, i, m] * y[i]
                gradient[k, step, m] = total
            for i in range(size):
                lq[i] = (1.0 - e) * lq[i] - e * rate * lv[i] + inertia[i] * y[i]
                lv[i] = (1.0 - e) * lv[i] + momentum[i] * y[i]
            if viscous.shape[0] > 0:
                for i in range(size):
                    for j in range(min(viscous.shape[2], size - i)):
                        lq[i + j] += viscous[s, i, j] * y[i]
                        if j > 0:
                            lq[i] += viscous[s, i, j] * y[i + j]
    for p in range(outputs.shape[0]):
        lq[outputs[p]] += weight[0, p]
    put(lq, start[0])
    put(lv, start[1])


@kernel
def sensitivity(
    pulse: Array,
    intervals: int,
    chunk: int,
    factors: Array,
    viscous: Array,
    inputs: Array,
    inertia: Array,
    momentum: Array,
    rate: float,
    extrapolate: Array,
    outputs: Array,
    out: Array,
) -> None:
    """Fill out (K+1, P, K, M): each output's change by a unit pulse of each input.

    pulse (R·S, M) is the pressure of the steps that follow the start of an interval. `chunk`
    intervals are propagated together, so that their columns stay in the nearest cache and fill the
    vector unit.
    """
    count = inputs.shape[2]
    size = inputs.shape[1]
    steps = factors.shape[0] // intervals
    for begin in range(0, intervals, chunk):
        end = min(intervals, begin + chunk)
        columns = (end - begin) * count
        dq = np.zeros((size, columns))
        dv = np.zeros((size, columns))
        y = np.zeros((size, columns))
        for k in range(begin, intervals):
            for step in range(steps):
                s = k * steps + step
                y[:] = 0.0
                for j in range(begin, min(end, k + 1)):
                    since = s - j * steps
                    if since < pulse.shape[0]:
                        for m in range(count):
                            size_of_pulse = pulse[since, m]
                            for i in range(size):
                                y[i, (j - begin) * count + m] = inputs[s, i, m] * size_of_pulse
                band = viscous[s] if viscous.shape[0] > 0 else viscous[:0].reshape(0, 1)
                advance(dq, dv, y, factors[s], band, inertia, momentum, rate,
                        extrapolate[s % extrapolate.shape[0]])  # fmt: skip
            for p in range(outputs.shape[0]):
                for c in range(columns):
                    out[k + 1, p, begin + c // count, c % count] = dq[outputs[p], c]
