"""Compiled simulation of many planar rods, one after another; see `elastic_kernel` for the symbols.

Each rod goes through `step_kernel.simulate`, so that its motion is that of a single simulation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.rod.banded_kernel import put
from der_planner.rod.compile import kernel
from der_planner.rod.planar.elastic_kernel import PlanarRod, PlanarSpace
from der_planner.rod.planar.step_kernel import simulate
from der_planner.rod.state import Array
from der_planner.rod.step_kernel import Body, Record, Solver

Indices = NDArray[np.int64]


@kernel
def simulate_range(
    begin: int, end: int, which: Indices, x: Array, v: Array, pressures: Array, rows: Indices,
    out: Array, failed: Indices, solver: Solver, tolerances: Array, record: Record, q: Array,
    rate: Array, space: PlanarSpace, bodies: Body, rods: PlanarRod,
) -> None:  # fmt: skip
    """Simulate the runs begin … end − 1 of R, K intervals of S steps each.

    which (R,) is the index of each run's rod in `bodies` and `rods`, whose arrays have one row a
    rod, as has tolerances. x, v (R, 2n) are the states at the start and become those at the end.
    pressures (R, K, S, M). out (R, K+1, P) receives the kernel unknowns `rows` (P,), failed (R,)
    the index of the step that did not converge, or −1. q, rate (K+1, 2n) and space are working
    memory, record is empty.
    """
    for run in range(begin, end):
        i = which[run]
        body = Body(bodies.mass[i], bodies.damping[i], bodies.load[i], bodies.fixed)
        rod = PlanarRod(
            rods.rest[i], rods.axial[i], rods.bend[i], rods.rest_kappa[i], rods.cubic[i],
            rods.viscous[i], rods.first[i], rods.last[i], rods.gain[i],
        )  # fmt: skip
        own = Solver(solver.h, solver.extrapolate, tolerances[i], solver.lever, solver.limit)
        put(x[run], q[0])
        put(v[run], rate[0])
        done, _, _, iterations = simulate(
            q, rate, x[run], v[run], pressures[run], 0, own, record, space, body, rod
        )
        failed[run] = done if iterations > 0 else -1
        for k in range(q.shape[0]):
            for p in range(rows.shape[0]):
                out[run, k, p] = q[k, rows[p]]
