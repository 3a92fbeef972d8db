"""Planning again from commands that were played, against what the model did not explain of them."""

from __future__ import annotations

import dataclasses
import time as clock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from der_planner.model.drive import STEPS
from der_planner.model.response import NODES, simulate
from der_planner.model.series import CONTROL_PERIOD
from der_planner.planning import models
from der_planner.planning.errors import PlanningError
from der_planner.planning.inverse import solve
from der_planner.planning.optimal import Optimiser, Outcome, Settings
from der_planner.planning.result import Plan
from der_planner.planning.ways import sample_spline
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]
_THREADS = ThreadpoolController()

_WINDOWS = (100, 150, 150)
"""Setpoints that are solved together in each round over the motion. Only the first is needed but
where limits bind: they are felt from further ahead than a plan's first window reaches, …"""
_NOTABLE_ERROR = 5e-4
"""… and where they leave more than this of mean tip error [m]."""
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
        PlanningError: the model of the plan is unknown, or its reference is out of reach.
    """

    def __init__(self, plan: Plan) -> None:
        physics = models.build(plan.limb, plan.model, NODES)
        self._physics = physics
        self._spline = physics.configuration(plan.reference)
        self._plan = plan

    @property
    def lever(self) -> float:
        """Largest movement of the tip per differential pressure of a segment at rest [m/Pa]."""
        limb = self._plan.limb
        ahead = np.cumsum([s.length for s in limb.segments][::-1])[::-1]
        return float(np.max(limb.static_gain * ahead))

    def expected(self, commands: Array) -> Expected:
        """Return what the model expects under commands (K, M) [Pa].

        Raises:
            PlanningError: the model cannot be rolled forward under them.
        """
        start = self._plan.reference.start
        try:
            response = simulate(
                self._physics,
                np.arange(len(commands)) * CONTROL_PERIOD,
                commands=commands,
                bend=lambda time: sample_spline(self._spline, time)[0],
                start=self._physics.begin(self._spline, start),
                before=None if start is None else start.pressure,
            )
        except ConvergenceError as error:
            raise _not_followed(error) from error
        return Expected(response.tip[:-1], response.differential_pressure.mean(axis=1))

    def plan(self, commands: Array, disturbance: Array, pull: float) -> Plan:
        """Return the optimum of |tip(u) + d − r̄|² under all limits, near given commands.

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
        try:
            # Matrices of a few hundred rows: more threads only get into other processes' way.
            with _THREADS.limit(limits=1, user_api="blas"):
                best, steps = self._solve(commands, wanted, pull)
        except ConvergenceError as error:
            raise _not_followed(error) from error
        return dataclasses.replace(
            self._plan,
            differential_pressure=best.commands,
            tip_predicted=best.tip + disturbance,
            method="learned",
            solve_time=clock.perf_counter() - begin,
            details={"steps": steps, "limited_windows": best.limited},
        )

    def _solve(self, commands: Array, wanted: Array, pull: float) -> tuple[Outcome, int]:
        """Return what is best for wanted tips (K, 2) [m], and the steps of all rounds."""
        best: Outcome | None = None
        missed, steps = np.inf, 0
        for window in _WINDOWS:
            settings = Settings(nearness=pull, nearness_vented=pull, window=window)
            offset = self._plan.tip_reference - wanted
            solver = Optimiser(
                self._physics,
                self._physics.begin(self._spline, self._plan.reference.start),
                self._spline,
                self._plan.reference,
                commands,
                STEPS,
                settings,
                offset=offset,
            )
            outcome = solver.run(begin=None if best is None else best.commands)
            left = float(np.linalg.norm(outcome.tip - wanted, axis=1).mean())
            steps += outcome.steps
            if best is None or left < missed:
                best, missed = outcome, left
            if not outcome.limited or left < _NOTABLE_ERROR:
                break
        if best is None:
            raise AssertionError("there is a first round")
        return best, steps

    def _reachable(self, wanted: Array) -> Array:
        """Return the points of the tip (K, 2) [m] that evenly bent segments reach instead.

        A straight limb reaches no further, and bends to no avail where more is wanted of it.
        """
        angles, _ = solve(self._physics.kinematics, wanted, self._plan.bend_angles, _PRIOR)
        reached: Array = self._physics.kinematics.tip(angles)
        return reached


def _not_followed(error: ConvergenceError) -> PlanningError:
    return PlanningError(
        f"the rod cannot be rolled forward against what was measured ({error}): check that the run "
        "belongs to this plan and this limb"
    )
