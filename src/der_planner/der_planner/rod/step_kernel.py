"""Compiled pieces of a time step that rods in a plane and in space share.

A step is a chain of solves. One solve is a backward Euler step over h = 1/rate:

    M rate (v − v_n) + D v = F(x),    v = rate (x − x_n),

after which the state goes on to (x_n, v_n) + e ((x, v) − (x_n, v_n)): e = 1 is backward Euler, e
= 2 over half a step the implicit midpoint rule, and γ, then 1, Alexander's SDIRK (Alexander,
"Diagonally implicit Runge-Kutta methods for stiff O.D.E.'s", SIAM J. Numer. Anal. 14, 1977).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.rod.banded_kernel import put
from der_planner.rod.compile import inlined_kernel, kernel


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
