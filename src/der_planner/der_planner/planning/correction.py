"""Planning again from commands that were played, against what the model did not explain of them."""

from __future__ import annotations

import copy
import dataclasses
import time as clock
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from der_planner.limb import Limb
from der_planner.model import NODES, Initial, simulate
from der_planner.model.series import CONTROL_PERIOD
from der_planner.model.simulation import STEPS, Bend
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
_ROUNDS = 2
"""With friction along the bend of the last round's commands; each leaves a fifth of its change …"""
_SETTLED = 2e-5
"""… and a smaller mean change of the tip is not worth another [m]."""
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
        self._limb = plan.limb

    def of(self, limb: Limb) -> Correction:
        """Return the same with another limb's model; its plans still name the plan's own limb.

        Args:
            limb: with as many segments.
        """
        other = copy.copy(self)
        other._limb, other._physics = limb, models.build(limb, self._plan.model, NODES)
        return other

    @property
    def limb(self) -> Limb:
        """The limb whose model it is."""
        return self._limb

    @property
    def tip_per_pressure(self) -> float:
        """Largest movement of the tip per differential pressure of a segment at rest [m/Pa]."""
        limb = self._limb
        ahead = np.cumsum([s.length for s in limb.segments][::-1])[::-1]
        return float(np.max(limb.static_gain * ahead))

    def expected(self, commands: Array) -> Expected:
        """Return what the model expects under commands (K, M) [Pa].

        Friction and creep act along the bend that these commands lead to.

        Raises:
            PlanningError: the model cannot be rolled forward under them.
        """
        return self._simulated(commands, None)

    def _simulated(self, commands: Array, bend: Bend | None) -> Expected:
        """Return what the model expects, with friction along this bend or its own (None)."""
        start = self._plan.reference.start
        try:
            response = simulate(
                self._physics,
                np.arange(len(commands)) * CONTROL_PERIOD,
                commands=commands,
                bend=bend,
                initial=Initial(
                    self._physics.begin(self._spline, start),
                    None if start is None else start.pressure,
                ),
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
        rubbed = tip - self._simulated(commands, self._own_bend).tip
        best: Outcome | None = None
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

    def _own_bend(self, time: Array) -> Array:
        """Return the bend of the plan's reference (n, M) [rad] at instants (n,) [s]."""
        return sample_spline(self._spline, time)[0]

    def _solve(
        self, commands: Array, wanted: Array, pull: float, begin: Outcome | None
    ) -> tuple[Outcome, int]:
        """Return the best commands for wanted tips (K, 2) [m], and the steps of all windows.

        Args:
            commands: (K, M) toward which the plan is pulled [Pa].
            pull: as of `plan`.
            wanted: of the model without what friction changes.
            begin: where the search starts; None: at ``commands``.
        """
        best, missed, steps = begin, np.inf, 0
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
            raise AssertionError("there is a first window")
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
