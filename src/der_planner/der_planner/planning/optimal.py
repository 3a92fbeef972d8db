"""Optimal pressures: Gauss-Newton on a model's own discrete dynamics, window after window.

Unknown are the commands u (K, M) themselves. Minimised is, over the setpoints k,

    Σ |tip_k(u) − r̄_k|² + λ Σ |D²(u − u⁰)_k|² + μ Σ |(u − u⁰)_k|²

with u⁰ the commands of a balance of forces (the warm start, smooth and nearly right: `projected`
for the rod, `paper` for the arcs), D² the second difference, |u_k| within the pressure limit and
|u_k − u_{k−1}| within the slew limit. The model is that of `der_planner.model`, with friction and
creep along the motion's known bend.

tip(u) comes from the model's integrator, its derivative from the exact linearisation of that
integrator, with the chambers' response averaged over each period. A response dies out in seconds,
so that a long motion is solved as a row of overlapping windows: each starts from the model's state
at the end of what the last one settled, and its tail, which does not yet know what follows, is
solved again by the next. Cost grows with the first power of the motion's length. Where no limit is
in the way the step is one Cholesky factorisation, else a quadratic programme (`solve_limited`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import piqp
from scipy.linalg import cho_factor, cho_solve

from der_planner.arrays import Array, rms_distance
from der_planner.model import CONTROL_PERIOD, STEPS, State
from der_planner.model.air import Air
from der_planner.model.commands import within_limits
from der_planner.model.simulation import Drive, Window
from der_planner.planning.configuration import Configuration
from der_planner.planning.loads import PlanningError
from der_planner.planning.motions import Reference
from der_planner.rod import ConvergenceError

_PRESSURE = 1e3
"""Pressure of one unit of the solver [Pa]: in kPa and mm its tolerances mean something."""
_LENGTH = 1e-3
"""Length of one unit of the solver [m]."""

_SMOOTHNESS = 4.8e-3
"""√λ, tip error that a second difference as large as the pressure limit is worth [m]."""
_NEARNESS = 2.4e-4
"""√μ, tip error that a deviation from the warm start by the pressure limit is worth [m]."""
_NEARNESS_VENTED = 7.2e-3
"""√μ of a limb whose chambers are vented slowly [m].

Close to the straight pose the tip hardly tells the segments apart, and what one of them is asked
for in vain must not be taken from the other.
"""
WINDOW = 100
"""Setpoints that are solved together."""
_SETTLED = 75
"""Setpoints of a window that are kept; the rest is solved again."""
_ITERATIONS = 6
"""Gauss-Newton steps a window at most."""
_DAMPING = 2.4e-3
"""Least tip error that a change by the pressure limit is worth once a step was too long [m]."""
_TOLERANCE = 1e-5
"""Root mean square tip error below which a window is done [m].

Another step that changes it by less than a fifth of this is not worth its time.
"""
_REUSE = 0.7
"""Share of the error that a step must take away for its linearisation to be used again."""


@dataclass(frozen=True)
class Optimum:
    """What the optimisation found.

    Attributes:
        commands: (K, M) [Pa].
        tip: (K, 2) of the model under them [m].
        steps: Gauss-Newton steps of all windows.
        limited: windows in which a limit was in the way.
    """

    commands: Array
    tip: Array
    steps: int
    limited: int


class Optimiser:
    """Solves window after window; see the module.

    Args:
        configuration: of the model along the motion.
        reference: r̄.
        warm: (K, M) commands where the search starts and toward which they are pulled: those of a
            balance, before limits, or the last ones played [Pa].
        offset: (K, 2) what is added to the model's tip at the setpoints before it is compared with
            r̄, e.g. what a run showed beyond the model [m]; None: nothing.
        nearness: √μ [m/Pa]; None: as the chambers are vented.
        window: setpoints that are solved together.
    """

    def __init__(
        self,
        configuration: Configuration,
        reference: Reference,
        warm: Array,
        offset: Array | None = None,
        nearness: float | None = None,
        window: int = WINDOW,
    ) -> None:
        self.model = model = configuration.model
        usual = _NEARNESS_VENTED if model.air.vents_slowly else _NEARNESS
        self._limit = model.air.pneumatics.pressure_limit
        self.nearness = usual / self._limit if nearness is None else nearness
        self.window = window
        wanted = reference.tip if offset is None else reference.tip - offset
        self.target = np.concatenate([wanted[1:], wanted[-1:]])
        self.warm = warm
        count, inputs = warm.shape
        self.start, start = configuration.begin, configuration.start
        self.before = np.zeros(inputs) if start is None else start.pressure
        self.drive = Drive(model, configuration.bend_at, count, STEPS, self.before)
        pulse = model.air.even_pulse(CONTROL_PERIOD, STEPS)
        self._pulse = np.tile(pulse[:, None], (1, inputs))

    def run(
        self, progress: Callable[[float], None] = lambda _share: None, begin: Array | None = None
    ) -> Optimum:
        """Solve all windows, one after the other.

        Args:
            progress: called with the share that is done, 0 … 1.
            begin: (K, M) commands where the search starts, if not at the warm start [Pa].
        """
        count = len(self.warm)
        first_guess = self.warm if begin is None else begin
        command = np.array(first_guess, dtype=float)
        state, before = self.start, self.before
        tip = np.empty((count, 2))
        first, steps, limited = 0, 0, 0
        while first < count:
            last = min(first + self.window, count)
            if count - last < self.window - _SETTLED:
                last = count
            keep = last if last == count else first + _SETTLED
            # The window before may have moved away from what was guessed of this one: a search that
            # begins beyond a limit may find nothing better within it.
            command[first:], _ = within_limits(
                command[first:], self.model.air, CONTROL_PERIOD, before
            )
            used, met = self.improve(command, state, first, last)
            steps, limited = steps + used, limited + met
            window = self.drive.window(command[:keep], first)
            motion = self.model.run(state, window.effective, CONTROL_PERIOD)
            tip[first:keep] = motion.tip[:-1]
            state, first, before = motion.final, keep, command[keep - 1]
            progress(first / count)
        return Optimum(command, tip, steps, limited)

    def improve(self, command: Array, state: State, first: int, last: int) -> tuple[int, bool]:
        """Improve ``command[first:last]`` in place; return the steps and if a limit was met."""
        air, met, damping = self.model.air, False, 0.0
        jacobian: Array | None = None
        cost, misses, window = self._evaluate(command, state, first, last)
        before = command[first - 1] if first else self.before
        for step in range(_ITERATIONS):
            rms = rms_distance(misses)
            if rms < _TOLERANCE:
                return step, met
            if jacobian is None:
                jacobian, hessian = self._linearise(window, state, damping)
                factor = cho_factor(hessian, lower=True)
            gradient = self._gradient(jacobian, misses, command[:last], first)
            present, trial = command[first:last], command[:last].copy()
            wanted = present - cho_solve(factor, gradient).reshape(present.shape)
            trial[first:], cut = within_limits(wanted, air, CONTROL_PERIOD, before)
            if cut > 0:
                met = True
                trial[first:] = solve_limited(hessian, gradient, present, before, air)
            try:
                new = self._evaluate(trial, state, first, last)
            except ConvergenceError:
                new = np.inf, misses, window
            if new[0] > cost:
                damping, jacobian = max(10 * damping, _DAMPING / self._limit), None
                continue
            gained = rms - rms_distance(new[1])
            command[:last] = trial
            cost, misses, window = new
            if gained < max(_TOLERANCE / 5, 0.02 * rms):
                return step + 1, met
            if gained < _REUSE * rms:
                jacobian = None
        return _ITERATIONS, met

    def _evaluate(
        self, command: Array, state: State, first: int, last: int
    ) -> tuple[float, Array, Window]:
        """Return the cost, the misses (W, 2) [m] and the pressures of a window."""
        window = self.drive.window(command[:last], first)
        motion = self.model.run(state, window.effective, CONTROL_PERIOD)
        misses = motion.tip[1:] - self.target[first:last]
        pulled = self._weights(last - first) @ self._deviation(command[:last], first)
        return float((misses**2).sum() + (pulled**2).sum()), misses, window

    def _gradient(self, jacobian: Array, misses: Array, command: Array, first: int) -> Array:
        """Return half the gradient (W·M,) of the cost at commands (first + W, M)."""
        weights = self._weights(len(command) - first)
        pull = weights[:, 2:].T @ (weights @ self._deviation(command, first))
        return jacobian.T @ misses.ravel() + pull.ravel()

    def _weights(self, size: int) -> Array:
        """Return smoothness and nearness as rows (2W, W + 2) on the deviations from u⁰ [m/Pa].

        The first two deviations are those of the setpoints before the window.
        """
        each = np.eye(size + 2)
        smooth = _SMOOTHNESS / self._limit * np.diff(each, 2, axis=0)
        return np.concatenate([smooth, self.nearness * each[2:]])

    def _deviation(self, command: Array, first: int) -> Array:
        """Return u − u⁰ (W + 2, M) from two setpoints before the window on."""
        before = np.zeros((2, command.shape[1]))
        return np.concatenate([before, command - self.warm[: len(command)]])[first:]

    def _linearise(self, window: Window, state: State, damping: float) -> tuple[Array, Array]:
        """Return the quadratic model of the cost around the commands of a window.

        It is ∂tip/∂command (2W, W·M) [m/Pa], and the Hessian (W·M, W·M) with smoothness and
        nearness [m²/Pa²].
        """
        linear = self.model.run(state, window.effective, CONTROL_PERIOD, "tip").linear
        if linear is None:
            raise AssertionError("a linearised motion has its sensitivity")
        slope = np.diagonal(window.slopes, axis1=-2, axis2=-1).mean(axis=1)
        if self.model.air.vents_slowly:
            # A chamber that falls as fast as its outlet lets it does not react to its command: the
            # chambers' response differs from command to command.
            by_pressure = linear.sensitivity(None)[1:] * slope
            spread = window.by_command().mean(axis=1)
            products = np.moveaxis(by_pressure, 3, 0) @ np.moveaxis(spread, 2, 0)[:, None]
            sensitivity = np.moveaxis(products, 0, 3)
        else:
            sensitivity = linear.sensitivity(self._pulse)[1:] * slope
        size, inputs = slope.shape
        J = sensitivity.reshape(2 * size, size * inputs)
        weights = self._weights(size)[:, 2:]
        pull = weights.T @ weights + damping**2 * np.eye(size)
        return J, J.T @ J + np.kron(pull, np.eye(inputs))


# Quadratic programmes --------------------------------------------------------------------------


def solve_limited(
    hessian: Array, gradient: Array, command: Array, before: Array, air: Air
) -> Array:
    """Return the commands (W, M) u + δ within all limits that minimise ½ δᵀHδ + gradientᵀδ [Pa].

    Args:
        hessian: H (W·M, W·M), positive definite [m²/Pa²].
        gradient: (W·M,) [m²/Pa].
        command: u (W, M), which keeps the limits itself [Pa].
        before: (M,) command before the first one [Pa].
        air: pressure and slew limit.

    Raises:
        PlanningError: the solver gave up, with its status.
    """
    total, inputs = command.size, command.shape[1]
    limit = air.pneumatics.pressure_limit
    largest = air.pneumatics.slew_limit * CONTROL_PERIOD
    difference = np.eye(total) - np.eye(total, k=-inputs)
    steps = np.diff(np.vstack([before, command]), axis=0).ravel()
    present = command.ravel()
    change = minimise(
        hessian,
        gradient,
        (difference, -largest - steps, largest - steps),
        (-limit - present, limit - present),
        tolerance=(1e-6, 1e-8),
    )
    # Cuts off the solver's rounding errors.
    return within_limits(command + change.reshape(command.shape), air, CONTROL_PERIOD, before)[0]


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
        PlanningError: the solver gave up, with its status.
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
        raise PlanningError(
            f"a quadratic programme of {len(gradient)} pressures was not solved ({status}): use "
            "the method projected, or a longer period"
        )
    return np.asarray(solver.result.x) * _PRESSURE
