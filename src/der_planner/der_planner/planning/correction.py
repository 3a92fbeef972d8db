"""Planning again from commands that were played, against what the model did not explain of them."""

from __future__ import annotations

import dataclasses
import time as clock

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from der_planner.model.drive import STEPS
from der_planner.model.response import NODES
from der_planner.planning import models
from der_planner.planning.errors import PlanningError
from der_planner.planning.optimal import Optimiser
from der_planner.planning.planner import tip_under
from der_planner.planning.result import Plan
from der_planner.planning.rod_model import PlanningRod
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]
_THREADS = ThreadpoolController()


class Correction:
    """The rod of a plan, ready to plan the same motion again.

    Args:
        plan: of the model ``der``, by any of its methods.

    Raises:
        PlanningError: the plan is one of the PCC model, which has no optimiser.
    """

    def __init__(self, plan: Plan) -> None:
        if plan.model != "der":
            raise PlanningError(
                f"a plan of the model '{plan.model}' cannot be corrected: only the rod's optimiser "
                "can; plan the motion with the model der"
            )
        physics = models.build(plan.limb, "der", NODES)
        if not isinstance(physics, PlanningRod):
            raise AssertionError("the model der is a rod")
        self._physics = physics
        self._spline = physics.configuration(plan.reference)
        self._plan = plan

    def tip(self, commands: Array) -> Array:
        """Return the tip (K, 2) [m] that the model expects under commands (K, M) [Pa]."""
        return tip_under(self._physics, self._spline, commands, self._plan.reference.start)

    def plan(self, commands: Array, disturbance: Array) -> Plan:
        """Return the optimum of |tip(u) + d − r̄|² under all limits, near given commands.

        The weak pull of `der_planner.planning.optimal` acts toward ``commands``.

        Args:
            commands: (K, M) where the search starts, usually the last ones played [Pa].
            disturbance: d (K, 2), measured tip less the model's, at the setpoints [m].

        Returns:
            The plan, with the method ``learned``; its `tip_predicted` includes the disturbance.

        Raises:
            PlanningError: the rod cannot be rolled forward, or a limited step has no solution.
        """
        begin = clock.perf_counter()
        solver = Optimiser(
            self._physics, self._spline, self._plan.reference, commands, STEPS, offset=disturbance
        )
        try:
            # Matrices of a few hundred rows: more threads only get into other processes' way.
            with _THREADS.limit(limits=1, user_api="blas"):
                outcome = solver.run()
        except ConvergenceError as error:
            raise PlanningError(
                f"the rod cannot be rolled forward against what was measured ({error}): check that "
                "the run belongs to this plan and this limb"
            ) from error
        return dataclasses.replace(
            self._plan,
            differential_pressure=outcome.commands,
            tip_predicted=outcome.tip + disturbance,
            method="learned",
            solve_time=clock.perf_counter() - begin,
            details={"steps": outcome.steps, "limited_windows": outcome.limited},
        )
