"""The receding horizon: corrections of the coming commands that bring the tip back to r̄(t).

From the estimate at the instant of the next command on, the linear system of
`der_planner.control.nominal` is rolled forward under the commands that would be sent without a new
correction. The corrections c (W, M), added to the plan's commands, then minimise

    Σ |tip − r̄|² + ν² Σ |δθ|² + λ² Σ |r_k − r_{k−1}|² + λ'² Σ |r_k − 2 r_{k−1} + r_{k−2}|²

where r is c less what makes up for the disturbances d and g, which are known ahead, with |command|
within the pressure limit, its change within the slew limit and |c| within the authority. ν keeps
the segments near the model's bend where the tip hardly tells them apart. The chambers' law, with
its slow venting, is linearised about the commands rolled forward. The change that the programme
finds, a half and a fifth of it are then rolled forward by the law itself, cut to commands that can
be sent, and the first that makes the sum less is taken, or none. Corrections are straight lines
between a few knots, close together at first, so that the programme has some thirty unknowns. The
horizon is longer than a chamber takes to vent: what a shorter one gains now it pays for after its
end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from der_planner.arrays import Array
from der_planner.control.estimation import Knowledge
from der_planner.control.nominal import ChamberLog, Nominal
from der_planner.methods import LEARNED
from der_planner.model import CONTROL_PERIOD, STEPS
from der_planner.model.air import Chambers
from der_planner.model.commands import within_limits
from der_planner.planning.loads import PlanningError
from der_planner.planning.optimal import minimise
from der_planner.planning.plan_file import Plan


@dataclass(frozen=True)
class HorizonSettings:
    """Sizes and weights.

    Attributes:
        knots: control periods at which corrections are free; the last one is the horizon's.
        bend: ν, tip error that a unit deviation of a bend is worth [m/rad].
        change: λ, tip error that a unit change of a correction is worth [m/Pa].
        smoothness: λ' [m/Pa].
    """

    knots: tuple[int, ...] = (0, 1, 2, 3, 5, 7, 10, 14, 19, 25, 32, 40, 50, 69)
    bend: float = 0.004
    change: float = 5e-6
    smoothness: float = 5e-6


def settings_of(plan: Plan) -> HorizonSettings:
    """Return sizes and weights for a plan.

    A learned plan already makes up for what repeats: its corrections are to be slow.
    """
    if plan.method.startswith(LEARNED):
        return HorizonSettings(change=2e-5, smoothness=2e-5)
    return HorizonSettings()


@dataclass(frozen=True)
class Allowed:
    """What a correction must keep.

    Attributes:
        authority: largest |correction| [Pa].
        limit: largest |command| [Pa].
        step: largest change from one command to the next [Pa].
    """

    authority: float
    limit: float
    step: float


_SHARES = (1.0, 0.5, 0.2)
"""Shares of the programme's change that are tried, in this order."""


class _Rolled(NamedTuple):
    """What corrections from control period ``first`` on lead to.

    Attributes:
        correction: (W, M) [Pa].
        chambers, before: what the chambers do, and the commands in it before ``first``.
        differential, effective: (W, S, M) in the chambers, and felt [Pa].
        misses: (W, 2) tip − r̄ at the ends of the periods [m].
        bends: (W, M) δθ there [rad].
    """

    first: int
    correction: Array
    chambers: Chambers
    before: int
    differential: Array
    effective: Array
    misses: Array
    bends: Array


class _Free(NamedTuple):
    """The part of the corrections that makes up for the disturbances d and g, and costs nothing.

    Attributes:
        before: (2, M) what was sent in the two periods before, less that part [Pa].
        ahead: (W, M) that part in the coming periods [Pa].
    """

    before: Array
    ahead: Array

    def beyond(self, correction: Array) -> Array:
        """Return r (W + 2, M) [Pa] of corrections (W, M)."""
        return np.concatenate([self.before, correction - self.ahead])


class Horizon:
    """Solves for the coming corrections; see the module.

    Args:
        nominal: the model's motion under the plan.
        chambers: their commands and readings.
        settings: sizes and weights.

    Attributes:
        solution: the newest: its control period, and the corrections (W, M) from it on [Pa].
    """

    def __init__(
        self, nominal: Nominal, chambers: ChamberLog, settings: HorizonSettings | None = None
    ) -> None:
        self._nominal, self._chambers = nominal, chambers
        self.settings = settings or HorizonSettings()
        self.window = self.settings.knots[-1] + 1
        self._hats = _hats(self.settings.knots)
        self._guess: tuple[int, Array] | None = None
        inputs = nominal.model.inputs
        weights = (1, self.settings.change), (2, self.settings.smoothness)
        self._differences = [
            weight * np.diff(np.eye(self.window + 2), order, axis=0)[2 - order :]
            for order, weight in weights
        ]
        self._difference_rows = [
            np.kron(each[:, 2:] @ self._hats, np.eye(inputs)) for each in self._differences
        ]
        self.solution = 0, np.zeros((self.window, inputs))

    def solve(self, first: int, known: Knowledge, allowed: Allowed) -> Array:
        """Return the correction (M,) [Pa] of the command of control period ``first``.

        Args:
            first: period.
            known: of the limb at its beginning.
            allowed: what corrections and commands must keep.
        """
        last = np.array([self._corrected(first - back) for back in (2, 1)])
        ahead = self._ahead(first, known)
        guess = self._begin(first, last[-1] - ahead[1]) + ahead[2:]
        guess = self._kept(first, guess, allowed)
        free = _Free(last - ahead[:2], ahead[2:])
        here = self._roll(first, guess, known)
        change = self._programme(here, known, allowed, free)
        best = self._searched(here, change, known, allowed, free)
        self._guess = first, best.correction - free.ahead
        self.solution = first, best.correction
        correction_now: Array = self.solution[1][0]
        return correction_now

    def _programme(self, here: _Rolled, known: Knowledge, allowed: Allowed, free: _Free) -> Array:
        """Return the change (W, M) [Pa] of corrections that is best to first order.

        Args:
            here: rolled forward without the change.
            known: of the limb.
            allowed: what corrections and commands must keep.
            free: what costs nothing.
        """
        inputs = here.correction.shape[1]
        jacobian, turned = self._derivatives(here, known)
        # Unknown is the change of the knots.
        knots = self._hats.shape[1] * inputs
        tip = jacobian.reshape(-1, knots)
        bend = self.settings.bend * turned.reshape(-1, knots)
        hessian = tip.T @ tip + bend.T @ bend
        gradient = tip.T @ here.misses.ravel() + self.settings.bend * (bend.T @ here.bends.ravel())
        run = free.beyond(here.correction)
        for each, rows in zip(self._differences, self._difference_rows, strict=True):
            hessian += rows.T @ rows
            gradient += rows.T @ (each @ run).ravel()
        change = self._within(hessian, gradient, here.first, here.correction, allowed)
        moved: Array = self._hats @ change.reshape(-1, inputs)
        return moved

    def _searched(
        self, here: _Rolled, change: Array, known: Knowledge, allowed: Allowed, free: _Free
    ) -> _Rolled:
        """Return the motion with the first of `_SHARES` of a change (W, M) [Pa] that is better.

        The programme knows the chambers to first order. Where they vent as fast as they can, a
        small command changes nothing and a larger one fills the other chamber of the pair: the
        whole change may do harm that a part of it does not.
        """
        least = self._minimised(here, free)
        for share in _SHARES:
            tried = self._kept(here.first, here.correction + share * change, allowed)
            there = self._roll(here.first, tried, known)
            if self._minimised(there, free) < least:
                return there
        return here

    def _minimised(self, rolled: _Rolled, free: _Free) -> float:
        """Return the sum that is minimised, see the module [m²]."""
        run = free.beyond(rolled.correction)
        squares = (rolled.misses**2).sum() + self.settings.bend**2 * (rolled.bends**2).sum()
        return float(squares + sum(((each @ run) ** 2).sum() for each in self._differences))

    def warm_up(self, known: Knowledge, allowed: Allowed) -> None:
        """Compile, or load from the cache, what `solve` calls."""
        self.solve(0, known, allowed)
        self._guess, self.solution = None, (0, np.zeros_like(self.solution[1]))

    def _ahead(self, first: int, known: Knowledge) -> Array:
        """Return the corrections (W + 2, M) [Pa] that make up for d and g, from two periods before.

        They are led by dead time and lag of the chambers.
        """
        nominal, inputs = self._nominal, self._nominal.model.inputs
        air_of = nominal.model.air.pneumatics
        lead = round((air_of.delay + air_of.time_constant) / CONTROL_PERIOD)
        periods = nominal.periods(first + lead + np.arange(-2, self.window))
        planned = nominal.effective.reshape(-1, STEPS, inputs)[periods].mean(axis=1)
        missing, gain = self._disturbance(known)
        lacking: Array = -(missing + gain * planned) / np.maximum(1.0 + gain, 0.3)
        return lacking

    def _disturbance(self, known: Knowledge) -> tuple[Array, Array]:
        """Return d [Pa] and g, (M,) each."""
        inputs = self._nominal.model.inputs
        _, missing, gain, _ = np.split(known.mean, np.arange(2, 5) * inputs)
        return missing, gain

    def _corrected(self, k: int) -> Array:
        """Return the correction (M,) that was sent for a period [Pa]."""
        return self._chambers.sent(k) - self._nominal.command(k)

    def _kept(self, first: int, correction: Array, allowed: Allowed) -> Array:
        """Return corrections (W, M) [Pa] cut to what they and the commands under them must keep.

        What is rolled forward must be what can be sent.
        """
        planned = self._nominal.commands[self._nominal.periods(first + np.arange(self.window))]
        wanted = planned + np.clip(correction, -allowed.authority, allowed.authority)
        commands, _ = within_limits(
            wanted, self._nominal.model.air, CONTROL_PERIOD, self._chambers.sent(first - 1)
        )
        kept: Array = commands - planned
        return kept

    def _begin(self, first: int, last: Array) -> Array:
        """Return the last solution, moved to begin now, (W, M) [Pa]."""
        if self._guess is None or not 0 <= first - self._guess[0] < self.window:
            return np.tile(last, (self.window, 1))
        gone = first - self._guess[0]
        before = self._guess[1]
        return before[np.minimum(np.arange(self.window) + gone, self.window - 1)]

    def _roll(self, first: int, correction: Array, known: Knowledge) -> _Rolled:
        """Return what corrections (W, M) [Pa] from a control period on lead to."""
        nominal, inputs = self._nominal, self._nominal.model.inputs
        periods = nominal.periods(first + np.arange(self.window))
        commands = nominal.commands[periods] + correction
        chambers, before = self._chambers.follow(first, commands)
        middle = (first * STEPS + np.arange(self.window * STEPS) + 0.5) * CONTROL_PERIOD / STEPS
        differential = chambers.differential[before:] + self._chambers.expected_gap(middle).reshape(
            self.window, STEPS, inputs
        )
        fine = nominal.steps(first * STEPS + np.arange(self.window * STEPS))
        here = nominal.steps(first * STEPS)
        taken = nominal.taken[fine] + (known.taken - nominal.taken[here])
        taken = taken.reshape(self.window, STEPS, inputs)
        effective = nominal.model.material.without_memory(differential, taken)
        missing, gain = self._disturbance(known)
        planned = nominal.effective[fine].reshape(self.window, STEPS, inputs).mean(axis=1)
        push = effective.mean(axis=1) * (1.0 + gain) + missing - planned
        pushed = np.einsum("wsb,wb->ws", nominal.input[periods], push)
        swing = known.mean[: 2 * inputs]
        bends = np.empty((self.window, inputs))
        for i, transition in enumerate(nominal.transition[periods]):
            swing = transition @ swing + pushed[i]
            bends[i] = swing[:inputs]
        ends = nominal.periods(first + 1 + np.arange(self.window))
        bend = nominal.bend[ends]
        misses = nominal.tip[ends] + nominal.moved_tip(bend, bends) - nominal.reference[ends]
        misses = misses + known.mean[-2:]
        return _Rolled(first, correction, chambers, before, differential, effective, misses, bends)

    def _derivatives(self, rolled: _Rolled, known: Knowledge) -> tuple[Array, Array]:
        """Return ∂misses (W, 2, knots·M) and ∂bends (W, M, knots·M) by the knots' corrections."""
        nominal, inputs = self._nominal, self._nominal.model.inputs
        slopes = nominal.model.material.slopes(rolled.differential, rolled.effective).mean(axis=1)
        slopes = slopes * (1.0 + self._disturbance(known)[1])[None, :, None]
        # Pressures by the knots' corrections, then swing by these, period after period.
        reached = rolled.chambers.derivative(rolled.before).mean(axis=1)
        reached = np.einsum("wvb,vn->wnb", reached, self._hats)
        periods = nominal.periods(rolled.first + np.arange(self.window))
        driven = np.einsum("wsb,wnb->wsnb", nominal.input[periods] @ slopes, reached)
        driven = driven.reshape(self.window, 2 * inputs, -1)
        moved = np.zeros(driven.shape[1:])
        turned = np.empty((self.window, inputs, driven.shape[2]))
        for i, transition in enumerate(nominal.transition[periods]):
            moved = transition @ moved + driven[i]
            turned[i] = moved[:inputs]
        bend = nominal.bend[nominal.periods(rolled.first + 1 + np.arange(self.window))]
        jacobian = nominal.kinematics.tip_jacobians(bend + rolled.bends) @ turned
        return jacobian, turned

    def _within(
        self, hessian: Array, gradient: Array, first: int, guess: Array, allowed: Allowed
    ) -> Array:
        """Return the change (knots·M,) of the knots [Pa] that is best within what is allowed."""
        change: Array = np.asarray(np.linalg.solve(hessian, -gradient), dtype=np.float64)
        inputs = guess.shape[1]
        periods = self._nominal.periods(first + np.arange(self.window))
        planned = self._nominal.commands[periods]
        low = np.maximum(-allowed.authority, -allowed.limit - planned) - guess
        high = np.minimum(allowed.authority, allowed.limit - planned) - guess
        bounds: Array = np.sort(np.stack([low, high]), axis=0)
        low, high = bounds
        command = np.concatenate([self._chambers.sent(first - 1)[None], planned + guess])
        steps = np.diff(command, axis=0)
        moves = np.diff(self._hats, axis=0, prepend=0.0)
        moved = self._hats @ change.reshape(-1, inputs)
        stepped = np.abs(steps + moves @ change.reshape(-1, inputs)).max()
        if np.all(moved >= low) and np.all(moved <= high) and stepped <= allowed.step:
            return change
        rows = (
            np.kron(np.concatenate([self._hats, moves]), np.eye(inputs)),
            np.concatenate([low, np.minimum(-allowed.step - steps, 0.0)]).ravel(),
            np.concatenate([high, np.maximum(allowed.step - steps, 0.0)]).ravel(),
        )
        try:
            return minimise(hessian, gradient, rows, None, tolerance=(1e-5, 1e-6))
        except PlanningError:
            return np.zeros(len(gradient))


def _hats(knots: tuple[int, ...]) -> Array:
    """Return the weights (W, knots) of straight lines between knots."""
    place = np.arange(knots[-1] + 1)
    return np.stack([np.interp(place, knots, column) for column in np.eye(len(knots))], axis=1)
