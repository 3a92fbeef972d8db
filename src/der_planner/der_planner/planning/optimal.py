"""Optimal pressures: Gauss-Newton on the rod's own discrete dynamics, window after window.

Unknown are the commands u (K, M) themselves. Minimised is, over the setpoints k,

    Σ |tip_k(u) − r̄_k|² + λ Σ |D²(u − u⁰)_k|² + μ Σ |(u − u⁰)_k|²

with u⁰ the `projected` commands (the warm start, smooth and nearly right), D² the second
difference, |u_k| within the pressure limit and |u_k − u_{k−1}| within the slew limit. The model is
everything the
limb file knows: hold, dead time and lag of the chambers, unequal chambers, friction and creep, the
rod.

tip(u) comes from the rod's integrator, its derivative from the exact linearisation of that
integrator.
A response dies out in seconds, so that a long motion is solved as a row of overlapping windows:
each starts from the rod's state at the end of what the last one settled, and its tail, which does
not yet know what follows, is solved again by the next. Cost grows with the first power of the
motion's length. Where no limit is in the way the step is one Cholesky factorisation, else the
quadratic programme is handed to `der_planner.planning.quadratic`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve

from der_planner import actuation
from der_planner.limb import Limb
from der_planner.planning import chambers, pneumatics
from der_planner.planning.motions import CONTROL_PERIOD, Reference, sample_spline
from der_planner.planning.quadratic import Band, solve_limited
from der_planner.planning.rod_model import RodModel
from der_planner.rod import ConvergenceError, RodState

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """What the optimisation weighs and when it is content.

    Attributes:
        smoothness: √λ, tip error that a unit second difference is worth [m/Pa].
        nearness: √μ, tip error that a unit deviation from the warm start is worth [m/Pa].
        nearness_vented: the same for a limb whose chambers are vented slowly [m/Pa]: close to the
            straight pose the tip hardly tells the segments apart, and what one of them is asked
            for in vain must not be taken from the other.
        window: setpoints that are solved together.
        settled: setpoints of a window that are kept; the rest is solved again.
        iterations: Gauss-Newton steps a window at most.
        tolerance: root mean square tip error below which a window is done, and change of it below
            which another step is not worth its time [m].
        reuse: share of the error that a step must take away for its linearisation to be used again.
    """

    smoothness: float = 2e-7
    nearness: float = 1e-8
    nearness_vented: float = 3e-7
    window: int = 100
    settled: int = 75
    iterations: int = 6
    tolerance: float = 1e-5
    reuse: float = 0.7


class Actuation:
    """From commands to the effective pressures of the rod along a known bend, and back by gradient.

    Args:
        limb: calibrated limb.
        spline: bend angles of the motion, for friction and creep.
        count: K commands.
        substeps: integrator steps a command.
        initial: (M,) command and chamber pressure before the first one [Pa].
    """

    def __init__(
        self, limb: Limb, spline: BSpline, count: int, substeps: int, initial: Vector
    ) -> None:
        self.air = limb.pneumatics
        self.substeps = substeps
        self.initial = initial
        slowest = max(self.air.time_constant, self.air.vent_time_constant)
        memory = self.air.delay + 25 * slowest + chambers.vent_memory(self.air)
        self._remembered = int(np.ceil(memory / CONTROL_PERIOD))
        middle = (np.arange(count * substeps, dtype=np.float64) + 0.5) * (CONTROL_PERIOD / substeps)
        bend = sample_spline(spline, middle)[0]
        taken = actuation.memory_pressures(limb, middle, bend)
        self._memory = taken.reshape(count, substeps, -1)
        self._limb = limb

    def effective(self, command: Vector, first: int) -> tuple[Vector, Vector]:
        """Return effective pressures (W, S, M) [Pa] from setpoint ``first`` on, and dw/dp (W, M).

        Args:
            command: (first + W, M) commands from the beginning [Pa].
            first: of the window.
        """
        response, _, begin = self._respond(command, first)
        pressure = response.pressure.reshape(-1, self.substeps, command.shape[1])
        held = pressure[first - begin :]
        memory = self._memory[first : len(command)]
        effective, slope = actuation.without_memory(self._limb, held, memory)
        return effective, slope.mean(axis=1)

    def _respond(self, command: Vector, first: int) -> tuple[chambers.Response, Vector, int]:
        """Return what chambers do from a setpoint on that no longer matters, from which, and it."""
        begin = max(0, first - self._remembered)
        before = command[begin - 1] if begin else self.initial
        response = chambers.respond(
            self.air, command[begin:], CONTROL_PERIOD, self.substeps, before
        )
        return response, before, begin

    def spread(self, command: Vector, first: int) -> Vector:
        """Return ∂(mean chamber pressure of a period)/∂command (W, W, M) of a window."""
        response, before, begin = self._respond(command, first)
        return chambers.sensitivity(
            self.air, response, before, CONTROL_PERIOD, self.substeps, first - begin
        )

    def pulse(self, inputs: int) -> Vector:
        """Return the chamber pressure (R, M) in the steps after one setpoint is raised by 1 Pa."""
        air, size = self.air, self.substeps
        mean = 0.5 * (air.time_constant + air.vent_lag)
        reach = int(np.ceil((air.delay + 12 * mean) / CONTROL_PERIOD)) + 1
        command = np.zeros((reach, 1))
        command[0] = 1.0
        even = type(air)(air.pressure_limit, air.slew_limit, air.fill_rate, mean, air.delay)
        response = pneumatics.chamber_pressures(even, command, CONTROL_PERIOD, size)
        return np.tile(response.reshape(-1, 1), (1, inputs))


class Quadratic:
    """The cost of a window around a linearisation: ½ δᵀHδ + gradientᵀδ.

    Args:
        jacobian: (2W, W·M) ∂tip/∂command [m/Pa].
        hessian: (W·M, W·M) with smoothness and nearness [m²/Pa²].
    """

    def __init__(self, jacobian: Vector, hessian: Vector) -> None:
        self.jacobian = jacobian
        self._hessian = hessian
        self._factor = cho_factor(hessian, lower=True)

    def step(self, gradient: Vector, band: Band) -> tuple[Vector, bool]:
        """Return the change (W, M) of the commands within the band, and if a limit shaped it."""
        change: Vector = -cho_solve(self._factor, gradient).reshape(band.command.shape)
        if band.contains(change):
            return change, False
        return solve_limited(self._hessian, gradient, band), True


@dataclass(frozen=True)
class Outcome:
    """What the optimisation found.

    Attributes:
        commands: (K, M) [Pa].
        tip: (K, 2) of the model under them [m].
        steps: Gauss-Newton steps of all windows.
        limited: windows in which a limit was in the way.
    """

    commands: Vector
    tip: Vector
    steps: int
    limited: int


class Optimiser:
    """Solves window after window; see the module.

    Args:
        model: the rod.
        spline: bend angles along the motion.
        reference: r̄, and where the motion starts.
        warm: (K, M) commands of `projected`, before limits [Pa].
        substeps: integrator steps a command.
        settings: weights and sizes.
    """

    def __init__(
        self,
        model: RodModel,
        spline: BSpline,
        reference: Reference,
        warm: Vector,
        substeps: int,
        settings: Settings | None = None,
    ) -> None:
        self.model = model
        self.settings = settings or Settings()
        vented = model.limb.pneumatics.vent_rate > 0
        self.nearness = self.settings.nearness_vented if vented else self.settings.nearness
        self.target = np.concatenate([reference.tip[1:], reference.tip[-1:]])
        self.warm = warm
        count, inputs = warm.shape
        start = reference.start
        self.before = np.zeros(inputs) if start is None else start.pressure
        self.start = model.rest if start is None else model.state(spline(0.0), spline(0.0, 1))
        self.actuation = Actuation(model.limb, spline, count, substeps, self.before)
        self._pulse = self.actuation.pulse(inputs)

    def run(self, progress: Callable[[float], None] = lambda _share: None) -> Outcome:
        """Solve all windows, one after the other."""
        air = self.model.limb.pneumatics
        count = len(self.warm)
        command, _ = pneumatics.within_limits(self.warm, air, CONTROL_PERIOD, self.before)
        state = self.start
        tip = np.empty((count, 2))
        first, steps, limited = 0, 0, 0
        while first < count:
            last = min(first + self.settings.window, count)
            if count - last < self.settings.window - self.settings.settled:
                last = count
            keep = last if last == count else first + self.settings.settled
            used, met = self.improve(command, state, first, last)
            steps, limited = steps + used, limited + met
            effective, _ = self.actuation.effective(command[:keep], first)
            motion = self.model.rod.simulate(
                state, effective, CONTROL_PERIOD, substeps=self.actuation.substeps
            )
            tip[first:keep] = motion.tip[:-1, :2]
            state, first = motion.final, keep
            progress(first / count)
        return Outcome(command, tip, steps, limited)

    def improve(self, command: Vector, state: RodState, first: int, last: int) -> tuple[int, bool]:
        """Improve ``command[first:last]`` in place; return the steps and if a limit was met."""
        settings = self.settings
        met, damping = False, 0.0
        quadratic: Quadratic | None = None
        cost, misses = self._evaluate(command, state, first, last)
        for step in range(settings.iterations):
            rms = _rms(misses)
            if rms < settings.tolerance:
                return step, met
            if quadratic is None:
                quadratic = self._linearise(command, state, first, last, damping)
            gradient = quadratic.jacobian.T @ misses.ravel() + self._pull(command, first, last)
            change, limited = quadratic.step(gradient, self._band(command, first, last))
            met = met or limited
            trial = command[:last].copy()
            trial[first:] += change
            try:
                new_cost, new_misses = self._evaluate(trial, state, first, last)
            except ConvergenceError:
                new_cost = np.inf
            if new_cost > cost:
                damping, quadratic = max(10 * damping, 1e-7), None
                continue
            gained = rms - _rms(new_misses)
            command[:last] = trial
            cost, misses = new_cost, new_misses
            if gained < max(settings.tolerance / 5, 0.02 * rms):
                return step + 1, met
            if gained < settings.reuse * rms:
                quadratic = None
        return settings.iterations, met

    def _evaluate(
        self, command: Vector, state: RodState, first: int, last: int
    ) -> tuple[float, Vector]:
        """Return the cost and the misses (W, 2) [m] of a window."""
        effective, _ = self.actuation.effective(command[:last], first)
        motion = self.model.rod.simulate(
            state, effective, CONTROL_PERIOD, substeps=self.actuation.substeps
        )
        misses = motion.tip[1:, :2] - self.target[first:last]
        return float((misses**2).sum()) + self._roughness(command, first, last), misses

    def _linearise(
        self, command: Vector, state: RodState, first: int, last: int, damping: float
    ) -> Quadratic:
        """Return the quadratic model of the cost around the commands of a window."""
        effective, slope = self.actuation.effective(command[:last], first)
        motion = self.model.rod.simulate(
            state, effective, CONTROL_PERIOD, substeps=self.actuation.substeps, linearise=True
        )
        if motion.linearisation is None:
            raise AssertionError("a linearised motion has a linearisation")
        if self.actuation.air.vent_rate > 0:
            # Where an outlet holds a chamber up, its command moves nothing: no two pulses alike.
            held = motion.linearisation.sensitivity()[1:, :2] * slope
            spread = self.actuation.spread(command[:last], first)
            products = np.moveaxis(held, 3, 0) @ np.moveaxis(spread, 2, 0)[:, None]
            sensitivity = np.moveaxis(products, 0, 3)
        else:
            sensitivity = motion.linearisation.sensitivity(self._pulse)[1:, :2] * slope
        size, inputs = last - first, command.shape[1]
        J = sensitivity.reshape(2 * size, size * inputs)
        second = _second_difference(size)
        weight = self.settings.smoothness**2 * second.T @ second
        weight[np.diag_indices(size)] += self.nearness**2 + damping**2
        return Quadratic(J, J.T @ J + np.kron(weight, np.eye(inputs)))

    def _deviation(self, command: Vector, first: int, last: int) -> Vector:
        """Return u − u⁰ (W + 2, M) from two setpoints before the window on."""
        deviation = np.zeros((last - first + 2, command.shape[1]))
        begin = max(0, first - 2)
        deviation[2 - (first - begin) :] = command[begin:last] - self.warm[begin:last]
        return deviation

    def _roughness(self, command: Vector, first: int, last: int) -> float:
        deviation = self._deviation(command, first, last)
        bends = np.diff(deviation, 2, axis=0)
        smooth, near = self.settings.smoothness, self.nearness
        return float(smooth**2 * (bends**2).sum() + near**2 * (deviation[2:] ** 2).sum())

    def _pull(self, command: Vector, first: int, last: int) -> Vector:
        """Return the gradient (W·M,) of smoothness and nearness."""
        deviation = self._deviation(command, first, last)
        second = _second_difference(last - first)
        rough = self.settings.smoothness**2 * second.T @ np.diff(deviation, 2, axis=0)
        pull: Vector = rough + self.nearness**2 * deviation[2:]
        return pull.ravel()

    def _band(self, command: Vector, first: int, last: int) -> Band:
        air = self.model.limb.pneumatics
        before = command[first - 1] if first else self.before
        return Band(
            command[first:last], before, air.pressure_limit, air.slew_limit * CONTROL_PERIOD
        )


def _rms(misses: Vector) -> float:
    return float(np.sqrt(np.mean((misses**2).sum(axis=1))))


def _second_difference(size: int) -> Vector:
    """Return the matrix (size, size) of second differences after two known values."""
    matrix = np.eye(size)
    matrix[np.arange(1, size), np.arange(size - 1)] = -2.0
    matrix[np.arange(2, size), np.arange(size - 2)] = 1.0
    return matrix
