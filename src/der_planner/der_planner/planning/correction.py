"""Planning again from commands that were played, against what the model did not explain of them."""

from __future__ import annotations

import copy
import dataclasses
import time as clock
from typing import NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, Model, simulate
from der_planner.model.simulation import Bend
from der_planner.planning.configuration import configure
from der_planner.planning.errors import PlanningError
from der_planner.planning.optimal import Optimiser, OptimiserSettings, Optimum
from der_planner.planning.plan_file import Plan
from der_planner.planning.workspace import solve
from der_planner.rod import ConvergenceError

_THREADS = ThreadpoolController()

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

    def of(self, limb: Limb) -> Correction:
        """Return the same with another limb's model; its plans still name the plan's own limb.

        Args:
            limb: with as many segments.
        """
        other = copy.copy(self)
        other._configuration = self._configuration.on(self.model.another(limb))
        return other

    @property
    def model(self) -> Model:
        """Of the limb."""
        return self._configuration.model

    @property
    def limb(self) -> Limb:
        """The limb whose model it is."""
        return self.model.limb

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
            response = simulate(
                self.model,
                np.arange(len(commands)) * CONTROL_PERIOD,
                commands=commands,
                bend=bend,
                initial=self._configuration.initial,
            )
        except ConvergenceError as error:
            raise _not_followed(error) from error
        return Expected(response.tip[:-1], response.differential_pressure.mean(axis=1))

    def plan(self, commands: Array, disturbance: Array, pull: float) -> Plan:
        """Return the optimum of |tip(u) + d − r̄|² under all limits, near given commands.

        The optimiser keeps friction along the plan's own bend. What friction along the bend of the
        commands changes of the tip is computed with each round and added to d.

        Args:
            commands: (K, M) toward which the plan is pulled, usually played ones [Pa].
            disturbance: d (K, 2), measured tip less the model's, at the setpoints [m].
            pull: tip error that a deviation from ``commands`` is worth [m/Pa].

        Returns:
            The plan, with the method ``learned``; its `tip_predicted` includes the disturbance.

        Raises:
            PlanningError: the model cannot be rolled forward, or a limited step has no solution.
        """
        begin = clock.perf_counter()
        wanted = self._reachable(self._plan.tip_reference - disturbance)
        tip = self.expected(commands).tip
        rubbed = tip - self.expected(commands, self._configuration.bend_at).tip
        best: Optimum | None = None
        steps = 0
        try:
            # Matrices of a few hundred rows: more threads only get into other processes' way.
            with _THREADS.limit(limits=1, user_api="blas"):
                for _ in range(_ROUNDS):
                    best, used = self._solve(commands, wanted - rubbed, pull, best)
                    steps += used
                    tip = self.expected(best.commands).tip
                    before, rubbed = rubbed, tip - best.tip
                    if np.linalg.norm(rubbed - before, axis=1).mean() < _SETTLED:
                        break
        except ConvergenceError as error:
            raise _not_followed(error) from error
        if best is None:
            raise AssertionError("there is a first round")
        return dataclasses.replace(
            self._plan,
            differential_pressure=best.commands,
            tip_predicted=tip + disturbance,
            method="learned",
            solve_time=clock.perf_counter() - begin,
            details={"steps": steps, "limited_windows": best.limited},
        )

    def _solve(
        self, commands: Array, wanted: Array, pull: float, begin: Optimum | None
    ) -> tuple[Optimum, int]:
        """Return the best commands for wanted tips (K, 2) [m], and the steps of all windows.

        Args:
            commands: (K, M) toward which the plan is pulled [Pa].
            pull: as of `plan`.
            wanted: of the model without what friction changes.
            begin: where the search starts; None: at ``commands``.
        """
        best, missed, steps = begin, np.inf, 0
        for window in _WINDOWS:
            settings = OptimiserSettings(nearness=pull, nearness_vented=pull, window=window)
            offset = self._plan.tip_reference - wanted
            solver = Optimiser(
                self._configuration, self._plan.reference, commands, settings, offset
            )
            outcome = solver.run(begin=None if best is None else best.commands)
            left = float(np.linalg.norm(outcome.tip - wanted, axis=1).mean())
            steps += outcome.steps
            if best is None or left < missed:
                best, missed = outcome, left
            if not outcome.limited or left < _NOTABLE_ERROR:
                break
        if best is None:
            raise AssertionError("there is a first window")
        return best, steps

    def _reachable(self, wanted: Array) -> Array:
        """Return the points of the tip (K, 2) [m] that evenly bent segments reach instead.

        A straight limb reaches no further, and bends to no avail where more is wanted of it.
        """
        angles, _ = solve(self.model.kinematics, wanted, self._plan.bend_angles, _PRIOR)
        reached: Array = self.model.kinematics.tip(angles)
        return reached


def _not_followed(error: ConvergenceError) -> PlanningError:
    return PlanningError(
        f"the rod cannot be rolled forward against what was measured ({error}): check that the run "
        "belongs to this plan and this limb"
    )
