"""Quadratic programmes over a band of commands: pressure limit and slew limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import piqp

from der_planner.arrays import Array
from der_planner.planning.errors import PlanningError

_PRESSURE = 1e3
"""Pressure of one unit of the solver [Pa]: in kPa and mm its tolerances mean something."""
_LENGTH = 1e-3
"""Length of one unit of the solver [m]."""


@dataclass(frozen=True)
class Band:
    """What a change of commands must keep.

    Attributes:
        command: (W, M) commands that are changed; they keep the limits themselves [Pa].
        before: (M,) command before the first one [Pa].
        limit: largest |command| [Pa].
        step: largest change from one command to the next [Pa].
    """

    command: Array
    before: Array
    limit: float
    step: float

    def contains(self, change: Array) -> bool:
        """Tell whether the changed commands (W, M) keep the limits."""
        command = self.command + change
        steps = np.diff(np.vstack([self.before, command]), axis=0)
        return bool(np.abs(command).max() <= self.limit and np.abs(steps).max() <= self.step)

    def cut(self, change: Array) -> Array:
        """Return the change (W, M) with a solver's rounding errors cut off, command by command."""
        result = np.empty_like(change)
        last = self.before
        for k in range(len(change)):
            command = np.clip(self.command[k] + change[k], last - self.step, last + self.step)
            last = np.clip(command, -self.limit, self.limit)
            result[k] = last - self.command[k]
        return result


def solve_limited(H: Array, gradient: Array, band: Band) -> Array:
    """Return the change δ (W, M) that minimises ½ δᵀHδ + gradientᵀδ within the band [Pa].

    Args:
        H: (W·M, W·M) positive definite [m²/Pa²].
        gradient: (W·M,) [m²/Pa].
        band: limits.

    Raises:
        PlanningError: the solver gave up, with its status.
    """
    size, inputs = band.command.shape
    total = size * inputs
    difference = np.eye(total) - np.eye(total, k=-inputs)
    steps = np.diff(np.vstack([band.before, band.command]), axis=0).ravel()
    present = band.command.ravel()
    try:
        change = minimise(
            H,
            gradient,
            (difference, -band.step - steps, band.step - steps),
            (-band.limit - present, band.limit - present),
            tolerance=(1e-6, 1e-8),
        )
    except UnsolvedError as error:
        raise PlanningError(
            f"the quadratic programme of {size} setpoints was not solved ({error}): "
            "use the method projected, or a longer period"
        ) from error
    return band.cut(change.reshape(size, inputs))


class UnsolvedError(Exception):
    """The solver gave up; the message is its status."""


def minimise(
    hessian: Array,
    gradient: Array,
    rows: tuple[Array, Array, Array],
    box: tuple[Array, Array] | None,
    tolerance: tuple[float, float],
) -> Array:
    """Return the pressures x (n,) [Pa] that minimise ½ xᵀ hessian x + gradientᵀ x under limits.

    Args:
        hessian: (n, n) positive definite [m²/Pa²].
        gradient: (n,) [m²/Pa].
        rows: matrix A (m, n), least and largest A x (m,) [Pa].
        box: least and largest x (n,) [Pa]; None: not limited.
        tolerance: of the solver, absolute and relative, in kPa and mm.

    Raises:
        UnsolvedError: the solver gave up.
    """
    matrix, low, high = rows
    least, largest = (None, None) if box is None else (box[0] / _PRESSURE, box[1] / _PRESSURE)
    scale = (_PRESSURE / _LENGTH) ** 2
    solver = piqp.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = tolerance
    solver.setup(
        np.asfortranarray(hessian * scale),
        gradient * scale / _PRESSURE,
        None,
        None,
        np.asfortranarray(matrix),
        low / _PRESSURE,
        high / _PRESSURE,
        least,
        largest,
    )
    status = solver.solve()
    if status != piqp.PIQP_SOLVED:
        raise UnsolvedError(status)
    return np.asarray(solver.result.x) * _PRESSURE
