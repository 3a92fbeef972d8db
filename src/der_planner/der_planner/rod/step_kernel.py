"""Compiled pieces of a time step that rods in a plane and in space share.

A step solves M·rate·((x − x_n)·rate − v_n) + D·rate·(x − x_n) = F(x) for x; body is the tuple of
mass, damping, load (n,) and of the fixed indices.
"""

from __future__ import annotations

from der_planner.rod.band_kernel import put
from der_planner.rod.compile import kernel
from der_planner.rod.state import Array, Arrays


@kernel
def predict(
    x: Array, x_n: Array, v_n: Array, acceleration: Array, h: float, fixed: Array, far: float,
    angles: bool,
) -> None:  # fmt: skip
    """Fill x with a guess of the step's end: the last acceleration goes on, unless it leads far.

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


@kernel
def add_inertia(residual: Array, s: Array, v: Array, v_n: Array, rate: float, body: Arrays) -> None:
    """Add inertia, mass-proportional damping and load to a residual and its derivative s."""
    mass, damping, load, _ = body
    for k in range(residual.shape[0]):
        residual[k] += mass[k] * rate * (v[k] - v_n[k]) + damping[k] * v[k] - load[k]
        s[k, 0] += rate * (mass[k] * rate + damping[k])


@kernel
def go_on(
    x: Array, x_n: Array, v_n: Array, acceleration: Array, rate: float, extrapolate: float
) -> None:
    """Move x_n, v_n to the step's end, `extrapolate` times the way to the solution x."""
    for d in range(x.shape[0]):
        velocity = (x[d] - x_n[d]) * rate
        acceleration[d] = (velocity - v_n[d]) * rate
        x_n[d] += extrapolate * (x[d] - x_n[d])
        v_n[d] += extrapolate * (velocity - v_n[d])
