"""The receding horizon: corrections of the coming commands that bring the tip back to r̄(t).

From the estimate at the instant of the next command on, the linear system of
`der_planner.estimation.nominal` is rolled forward under the commands that would be sent without a
new correction. It begins with the limb's bends, and with the plan's rates: a command takes effect
some 0.2 s after the picture that it answers. On a limb whose frequency is not what the model says,
a swing is by then in another phase than expected and would be driven. Swings are left to the
limb's own damping. The corrections c (W, M), added to the plan's commands, then minimise

    Σ |tip − r̄|² + ν² Σ |δθ|² + λ² Σ |r_k − r_{k−1}|² + λ² Σ |r_k − 2 r_{k−1} + r_{k−2}|²

where r is c less what makes up for the disturbances d and g, which are known ahead, with |command|
within the pressure limit, its change within the slew limit, |c| within the authority, and no c from
which the slew limit keeps commands from the plan for longer than a second. ν keeps the segments
near the model's bend where the tip hardly tells them apart. The chambers' law, with its slow
venting, is linearised about the commands rolled forward. The change that the programme finds, a
half and a fifth of it are then rolled forward by the law itself, cut to commands that can be sent,
and the first that makes the sum less is taken, or none. Corrections are straight lines between a
few knots, close together at first, so that the programme has some thirty unknowns. The horizon is
longer than a chamber takes to vent: what a shorter one gains now it pays for after its end.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from der_planner.arrays import Array, interpolate
from der_planner.estimation.knowledge import Knowledge
from der_planner.estimation.nominal import ChamberLog, Nominal
from der_planner.model import CONTROL_PERIOD, STEPS
from der_planner.model.air import Chambers
from der_planner.model.commands import within_limits
from der_planner.planning.loads import PlanningError
from der_planner.planning.optimal import minimise

_KNOTS = (0, 1, 2, 3, 5, 7, 10, 14, 19, 25, 32, 40, 50, 69)
"""Control periods at which corrections are free; the last one is the horizon's."""
_BEND = 0.004
"""ν, tip error that a unit deviation of a bend is worth [m/rad]."""
_CHANGE = 0.12
"""λ, tip error that a change of a correction by the pressure limit is worth [m]."""
_CHANGE_LEARNED = 0.48
"""λ on a learned plan, which makes up for what repeats, so that corrections may be slow [m]."""
_BACK = 20
"""Control periods within which the slew limit must let commands come back to the plan: where that
fills or vents as fast as it may, a correction that stays makes the limb late."""
_SHARES = (1.0, 0.5, 0.2)
"""Shares of the programme's change that are tried, in this order."""
_ROUNDING = 1e-6
"""A change of corrections by less than this is rounding [Pa]."""


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


class Horizon:
    """Solves for the coming corrections; see the module.

    Args:
        nominal: the model's motion under the plan.
        chambers: their commands and readings.
        authority: largest |correction| [Pa].

    Attributes:
        solution: the newest: its control period, and the corrections (W, M) from it on [Pa].
    """

    def __init__(self, nominal: Nominal, chambers: ChamberLog, authority: float) -> None:
        self._nominal, self._chambers, self._authority = nominal, chambers, authority
        self._air, inputs = nominal.model.air, nominal.model.inputs
        self.window = _KNOTS[-1] + 1
        self._hats = interpolate(np.arange(self.window), np.array(_KNOTS), np.eye(len(_KNOTS)))
        self._guess: tuple[int, Array] | None = None
        weight, each = _CHANGE_LEARNED if nominal.is_learned else _CHANGE, np.eye(self.window + 2)
        weight /= self._air.pneumatics.pressure_limit
        # First and second differences of r, from two periods before the horizon on.
        self._changes = weight * np.concatenate([np.diff(each, axis=0)[1:], np.diff(each, 2, 0)])
        self._knot_changes = np.kron(self._changes[:, 2:] @ self._hats, np.eye(inputs))
        self.solution = 0, np.zeros((self.window, inputs))

    def solve(self, first: int, known: Knowledge) -> Array:
        """Return the correction (M,) [Pa] of the command of control period ``first``.

        Args:
            first: period.
            known: of the limb at its beginning.
        """
        sent = np.array(
            [self._chambers.sent(k) - self._nominal.command(k) for k in (first - 2, first - 1)]
        )
        ahead = self._ahead(first, known)
        guess = self._kept(first, self._begin(first, sent[1] - ahead[1]) + ahead[2:])
        # What costs nothing (W + 2, M), less what was sent in the two periods before: r is a
        # correction less this.
        free = np.concatenate([ahead[:2] - sent, ahead[2:]])
        here = self._roll(first, guess, known)
        best = self._searched(here, self._programme(here, known, free), known, free)
        self._guess = first, best.correction - ahead[2:]
        self.solution = first, best.correction
        correction_now: Array = best.correction[0]
        return correction_now

    def _programme(self, here: _Rolled, known: Knowledge, free: Array) -> Array:
        """Return the change (W, M) [Pa] of corrections that is best to first order.

        Args:
            here: rolled forward without the change.
            known: of the limb.
            free: see `solve`.
        """
        jacobian, turned = self._derivatives(here, known)
        inputs = here.correction.shape[1]
        # Unknown is the change of the knots.
        knots = self._hats.shape[1] * inputs
        rows = [jacobian.reshape(-1, knots), _BEND * turned.reshape(-1, knots), self._knot_changes]
        left = [here.misses, _BEND * here.bends, self._changes @ _less(here.correction, free)]
        hessian, gradient = np.zeros((knots, knots)), np.zeros(knots)
        for slope, residual in zip(rows, left, strict=True):
            hessian += slope.T @ slope
            gradient += slope.T @ residual.ravel()
        best = np.linalg.solve(hessian, -gradient)
        change: Array = self._hats @ best.reshape(-1, inputs)
        wanted = here.correction + change
        if np.abs(self._kept(here.first, wanted) - wanted).max() < _ROUNDING:
            return change
        return self._hats @ self._limited(hessian, gradient, here).reshape(-1, inputs)

    def _limited(self, hessian: Array, gradient: Array, here: _Rolled) -> Array:
        """Return the change (knots·M,) of the knots [Pa] that is best within all limits."""
        air, guess = self._air.pneumatics, here.correction
        planned = self._planned(here.first)
        least, most = self._bounds(here.first)
        low = np.maximum(least, -air.pressure_limit - planned) - guess
        high = np.minimum(most, air.pressure_limit - planned) - guess
        low, high = np.minimum(low, high), np.maximum(low, high)  # a plan may round beyond a limit
        command = np.concatenate([self._chambers.sent(here.first - 1)[None], planned + guess])
        steps, largest = np.diff(command, axis=0), air.slew_limit * CONTROL_PERIOD
        moves = np.diff(self._hats, axis=0, prepend=0.0)
        rows = (
            np.kron(np.concatenate([self._hats, moves]), np.eye(guess.shape[1])),
            np.concatenate([low, np.minimum(-largest - steps, 0.0)]).ravel(),
            np.concatenate([high, np.maximum(largest - steps, 0.0)]).ravel(),
        )
        try:
            return minimise(hessian, gradient, rows, None, tolerance=(1e-5, 1e-6))
        except PlanningError:
            return np.zeros(len(gradient))

    def _searched(self, here: _Rolled, change: Array, known: Knowledge, free: Array) -> _Rolled:
        """Return the motion with the first of `_SHARES` of a change (W, M) [Pa] that is better.

        The programme knows the chambers to first order. Where they vent as fast as they can, a
        small command changes nothing and a larger one fills the other chamber of the pair: the
        whole change may do harm that a part of it does not.
        """
        least = self._minimised(here, free)
        for share in _SHARES:
            tried = self._kept(here.first, here.correction + share * change)
            there = self._roll(here.first, tried, known)
            if self._minimised(there, free) < least:
                return there
        return here

    def _minimised(self, rolled: _Rolled, free: Array) -> float:
        """Return the sum that is minimised, see the module [m²]."""
        changes = self._changes @ _less(rolled.correction, free)
        squares = (rolled.misses**2).sum() + _BEND**2 * (rolled.bends**2).sum()
        return float(squares + (changes**2).sum())

    def _ahead(self, first: int, known: Knowledge) -> Array:
        """Return the corrections (W + 2, M) [Pa] that make up for d and g, from two periods before.

        They are led by dead time and lag of the chambers.
        """
        nominal, of = self._nominal, self._air.pneumatics
        lead = round((of.delay + of.time_constant) / CONTROL_PERIOD)
        periods = nominal.periods(first + lead + np.arange(-2, self.window))
        planned = nominal.effective.reshape(-1, STEPS, nominal.model.inputs)[periods].mean(axis=1)
        _, _, missing, gain, _ = known.parts
        lacking: Array = -(missing + gain * planned) / np.maximum(1.0 + gain, 0.3)
        return lacking

    def _bounds(self, first: int) -> tuple[Array, Array]:
        """Return the least and the largest correction (W, M) [Pa]: authority, and see `_BACK`."""
        moves = self._planned(first + _BACK) - self._planned(first)
        back = self._air.pneumatics.slew_limit * CONTROL_PERIOD * _BACK
        least = np.clip(moves - back, -self._authority, 0.0)
        return least, np.clip(moves + back, 0.0, self._authority)

    def _planned(self, first: int) -> Array:
        """Return the plan's commands (W, M) from a control period on [Pa]."""
        return self._nominal.commands[self._nominal.periods(first + np.arange(self.window))]

    def _kept(self, first: int, correction: Array) -> Array:
        """Return corrections (W, M) [Pa] cut to what they and the commands under them must keep.

        What is rolled forward must be what can be sent.
        """
        planned = self._planned(first)
        wanted = planned + np.clip(correction, *self._bounds(first))
        commands, _ = within_limits(
            wanted, self._air, CONTROL_PERIOD, self._chambers.sent(first - 1)
        )
        return commands - planned

    def _begin(self, first: int, last: Array) -> Array:
        """Return the last solution, moved to begin now, (W, M) [Pa]."""
        if self._guess is None or not 0 <= first - self._guess[0] < self.window:
            return np.tile(last, (self.window, 1))
        begun, before = self._guess
        return before[np.minimum(np.arange(self.window) + first - begun, self.window - 1)]

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
        _, _, missing, gain, offset = known.parts
        planned = nominal.effective[fine].reshape(self.window, STEPS, inputs).mean(axis=1)
        push = effective.mean(axis=1) * (1.0 + gain) + missing - planned
        transitions, inputs_of = nominal.moves(periods, known.stiffness_ratio)
        pushed = np.einsum("wsb,wb->ws", inputs_of, push)
        swing = np.append(known.mean[:inputs], np.zeros(inputs))
        bends = np.empty((self.window, inputs))
        for i, transition in enumerate(transitions):
            swing = transition @ swing + pushed[i]
            bends[i] = swing[:inputs]
        ends = nominal.periods(first + 1 + np.arange(self.window))
        bend = nominal.bend[ends]
        misses = nominal.tip[ends] + nominal.moved_tip(bend, bends) - nominal.reference[ends]
        misses = misses + offset
        return _Rolled(first, correction, chambers, before, differential, effective, misses, bends)

    def _derivatives(self, rolled: _Rolled, known: Knowledge) -> tuple[Array, Array]:
        """Return ∂misses (W, 2, knots·M) and ∂bends (W, M, knots·M) by the knots' corrections."""
        nominal, inputs = self._nominal, self._nominal.model.inputs
        slopes = nominal.model.material.slopes(rolled.differential, rolled.effective).mean(axis=1)
        slopes = slopes * (1.0 + known.parts[3])[None, :, None]
        # Pressures by the knots' corrections, then swing by these, period after period.
        reached = rolled.chambers.derivative(rolled.before).mean(axis=1)
        reached = np.einsum("wvb,vn->wnb", reached, self._hats)
        periods = nominal.periods(rolled.first + np.arange(self.window))
        transitions, inputs_of = nominal.moves(periods, known.stiffness_ratio)
        driven = np.einsum("wsb,wnb->wsnb", inputs_of @ slopes, reached)
        driven = driven.reshape(self.window, 2 * inputs, -1)
        moved = np.zeros(driven.shape[1:])
        turned = np.empty((self.window, inputs, driven.shape[2]))
        for i, transition in enumerate(transitions):
            moved = transition @ moved + driven[i]
            turned[i] = moved[:inputs]
        bend = nominal.bend[nominal.periods(rolled.first + 1 + np.arange(self.window))]
        jacobian = nominal.kinematics.tip_jacobians(bend + rolled.bends) @ turned
        return jacobian, turned


def _less(correction: Array, free: Array) -> Array:
    """Return r (W + 2, M) [Pa] of corrections (W, M), see `Horizon.solve`."""
    rest = -free
    rest[2:] += correction
    return rest
