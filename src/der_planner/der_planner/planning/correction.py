"""Planning again from commands that were played, against what the model did not explain of them.

A learned plan also is a start for a new motion: the same one, a little slower or larger. What it
knows beyond its model is the disturbance d(t) = tip expected − model(commands). A motion of another
period or amplitude meets nearly the same one at the same phase, so that d is stretched to the new
duration, scaled by the amplitude, and planned against (`carried_over`).
"""

from __future__ import annotations

import copy
import dataclasses
import math
import time as clock
from pathlib import Path
from typing import NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array, interpolate
from der_planner.limb import Limb
from der_planner.methods import LEARNED
from der_planner.model import Model
from der_planner.model.bending import inverse_kinematics
from der_planner.model.simulation import Bend
from der_planner.planning.configuration import configure
from der_planner.planning.loads import PlanningError
from der_planner.planning.optimal import Optimiser, Optimum
from der_planner.planning.plan_file import SUFFIX, Plan, difference, read_plan
from der_planner.rod import ConvergenceError

_THREADS = ThreadpoolController()
PULL = 0.015
"""Pull toward the best commands, over the tip's movement per pressure.

The model's answer to a change of commands is wrong by some per cent of the movement of each
segment, even where they cancel at the tip. A weaker pull lets segments wander against each other
near the straight pose, where the tip hardly tells them apart.
"""
NEAR = math.log(1.35)
"""Largest logarithm of the ratio of two periods and amplitudes that are near each other."""
_WINDOWS = (100, 150, 150)
"""Setpoints that are solved together, for each try; a longer window feels limits further ahead."""
_NOTABLE_ERROR = 5e-4
"""Mean tip error that limits may leave without another try with a longer window [m]."""
_ROUNDS = 2
"""Rounds of friction along the bend of the last commands; each leaves a fifth of its change."""
_SETTLED = 2e-5
"""Mean change of the tip by friction below which no further round is worth its time [m]."""
_PRIOR = 3e-4
"""Pull toward the plan's bend angles where the tip hardly tells them [m/rad]."""


class Expected(NamedTuple):
    """What the model expects under commands.

    Attributes:
        tip: (K, 2) at the instants of the commands [m].
        pressure: (K, M) mean differential pressure in the chambers while each is in force [Pa].
    """

    tip: Array
    pressure: Array


class Correction:
    """The model of a plan, ready to plan the same motion again.

    Args:
        plan: by any method.

    Raises:
        PlanningError: the plan's reference is out of reach.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._configuration = configure(plan.body, plan.reference)

    def for_limb(self, limb: Limb) -> Correction:
        """Return the same with another limb's model; its plans still name the plan's own limb.

        Args:
            limb: with as many segments.
        """
        other = copy.copy(self)
        other._configuration = self._configuration.with_model(self.model.another(limb))
        return other

    @property
    def model(self) -> Model:
        """Of the limb."""
        return self._configuration.model

    @property
    def tip_per_pressure(self) -> float:
        """Largest movement of the tip per differential pressure of a segment at rest [m/Pa]."""
        limb = self.model.limb
        ahead = np.cumsum([s.length for s in limb.segments][::-1])[::-1]
        return float(np.max(limb.static_gain * ahead))

    def expected(self, commands: Array, bend: Bend | None = None) -> Expected:
        """Return what the model expects under commands (K, M) [Pa].

        Args:
            commands: (K, M) [Pa].
            bend: along which friction and creep act; None: along the bend that these commands lead
                to.

        Raises:
            PlanningError: the model cannot be rolled forward under them.
        """
        try:
            response = self._configuration.response(commands, bend)
        except ConvergenceError as error:
            raise _not_followed(error) from error
        return Expected(response.tip[:-1], response.differential_pressure.mean(axis=1))

    def plan(self, commands: Array, disturbance: Array, pull: float = PULL) -> Plan:
        """Return the optimum of |tip(u) + d − r̄|² under all limits, near given commands.

        The optimiser keeps friction along the plan's own bend. What friction along the bend of the
        commands changes of the tip is computed with each round and added to d.

        Args:
            commands: (K, M) toward which the plan is pulled, usually played ones [Pa].
            disturbance: d (K, 2), measured tip less the model's, at the setpoints [m].
            pull: tip error that a deviation from ``commands`` is worth, over the tip's movement.

        Returns:
            The plan, with the method ``learned``; its `tip_predicted` includes the disturbance.

        Raises:
            PlanningError: the model cannot be rolled forward, or a limited step has no solution.
        """
        started = clock.perf_counter()
        wanted = self._reachable(self._plan.tip_reference - disturbance)
        tip = self.expected(commands).tip
        rubbed = tip - self.expected(commands, self._configuration.bend_at).tip
        begin = commands
        try:
            # Matrices of a few hundred rows: more threads only get into other processes' way.
            with _THREADS.limit(limits=1, user_api="blas"):
                for _ in range(_ROUNDS):
                    best = self._solve(commands, wanted - rubbed, pull, begin)
                    begin, tip = best.commands, self.expected(best.commands).tip
                    before, rubbed = rubbed, tip - best.tip
                    if np.linalg.norm(rubbed - before, axis=1).mean() < _SETTLED:
                        break
        except ConvergenceError as error:
            raise _not_followed(error) from error
        return dataclasses.replace(
            self._plan,
            differential_pressure=best.commands,
            tip_predicted=tip + disturbance,
            method=LEARNED,
            solve_time=clock.perf_counter() - started,
        )

    def _solve(self, commands: Array, wanted: Array, pull: float, begin: Array) -> Optimum:
        """Return the best commands for wanted tips (K, 2) [m].

        Args:
            commands: (K, M) toward which the plan is pulled [Pa].
            wanted: of the model without what friction changes.
            pull: as of `plan`.
            begin: (K, M) where the search starts [Pa].
        """
        weight, offset = pull * self.tip_per_pressure, self._plan.tip_reference - wanted
        found: list[tuple[float, Optimum]] = []
        for window in _WINDOWS:
            solver = Optimiser(
                self._configuration, self._plan.reference, commands, offset, weight, window
            )
            outcome = solver.run(begin=begin)
            missed = float(np.linalg.norm(outcome.tip - wanted, axis=1).mean())
            found.append((missed, outcome))
            best = min(found, key=lambda entry: entry[0])[1]
            if not outcome.limited or missed < _NOTABLE_ERROR:
                break
            begin = best.commands
        return best

    def _reachable(self, wanted: Array) -> Array:
        """Return the points (K, 2) [m] that the limb reaches in place of wanted ones of its tip.

        A straight limb reaches no further, and bends to no avail where more is wanted of it. A limb
        that hangs through is asked near its own poses: evenly bent ones reach elsewhere.
        """
        near = self._configuration.near(self._plan.time)
        angles, _ = inverse_kinematics(near, wanted, self._plan.bend_angles, _PRIOR)
        return near.tip(angles)


def _not_followed(error: ConvergenceError) -> PlanningError:
    return PlanningError(
        f"the rod cannot be rolled forward against what was measured ({error}): check that the run "
        "belongs to this plan and this limb"
    )


# A learned plan as a start for another motion --------------------------------------------------


def nearest(folder: str | Path, wanted: Plan) -> tuple[Path, Plan] | None:
    """Return the learned plan that is nearest to a fresh one, and its file; None: none is near.

    It is of the same limb under the same loads, model, motion and number of cycles, with period and
    amplitude within a third. Of several the nearest, then the newest is taken; files that hold no
    plan are passed over.

    Args:
        folder: of plan files.
        wanted: the motion planned without what was learned.
    """
    found: list[tuple[float, float, Path, Plan]] = []
    for file in sorted(Path(folder).glob(f"*{SUFFIX}")):
        try:
            kept = read_plan(file)
        except PlanningError:
            continue
        far = _distance(kept, wanted)
        if kept.method == LEARNED and far <= NEAR:
            found.append((round(far, 6), -file.stat().st_mtime, file, kept))
    if not found:
        return None
    _, _, file, kept = min(found, key=lambda entry: entry[:2])
    return file, kept


def _distance(one: Plan, other: Plan) -> float:
    """Return how far apart two plans are, infinite where nothing can be carried over."""
    same = all(getattr(one, key) == getattr(other, key) for key in ("motion", "model", "cycles"))
    numbers = (one.period, other.period, one.amplitude, other.amplitude)
    if not same or min(numbers) <= 0 or one.reference.start is not None:
        return math.inf
    if difference(one.limb.to_mapping(), other.limb.to_mapping()):
        return math.inf
    slower, larger = one.period / other.period, one.amplitude / other.amplitude
    return math.hypot(math.log(slower), math.log(larger))


def carried_over(fresh: Plan, learned: Plan) -> Plan:
    """Return the plan of a motion that begins from what a near one has learned.

    Args:
        fresh: the motion planned without it.
        learned: see `nearest`.

    Raises:
        PlanningError: a model cannot be rolled forward, or the optimiser found no plan.
    """
    model = Correction(learned).expected(learned.differential_pressure).tip
    shown = (learned.tip_predicted - model) * (fresh.amplitude / learned.amplitude)
    phase = fresh.time * (learned.duration / fresh.duration)
    expected = interpolate(phase, learned.time, shown)
    return Correction(fresh).plan(fresh.differential_pressure, expected)
