"""Replan the coming seconds of a plan from a measured state, within one control period."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.planning.errors import PlanningError
from der_planner.planning.optimal import Optimiser, Settings
from der_planner.planning.planner import SUBSTEPS
from der_planner.planning.result import Plan
from der_planner.planning.rod_model import NODES, RodModel

Vector = NDArray[np.float64]

HORIZON = 40
"""Setpoints that are planned anew: 2 s."""


class RecedingHorizon:
    """Keeps a plan on its path: one Gauss-Newton step from where the limb is.

    The step is over the coming setpoints, that of the method ``optimal`` with its limits, from the
    measured bend angles and rates; the chambers' lag behind the commands already given is part of
    it. Beyond the horizon the plan stays as it was; the next call moves the horizon on.

    Args:
        plan: of the rod, by any method.
        nodes: of the rod.
        horizon: setpoints that are planned anew.
        settings: weights; one step by default, since the next call follows 50 ms later.

    Raises:
        PlanningError: the plan is not of the rod, or the horizon is too short.
    """

    def __init__(
        self,
        plan: Plan,
        nodes: int = NODES,
        horizon: int = HORIZON,
        settings: Settings | None = None,
    ) -> None:
        if plan.model != "der":
            raise PlanningError(
                f"only plans of the rod can be replanned, this is of '{plan.model}'"
            )
        if horizon < 4:
            raise PlanningError(f"the horizon must be 4 setpoints or more, got {horizon}")
        self.plan = plan
        self.horizon = horizon
        self.commands = plan.differential_pressure.copy()
        model = RodModel(plan.limb, nodes)
        self._model = model
        self._solver = Optimiser(
            model,
            model.configuration(plan.reference),
            plan.reference,
            plan.differential_pressure,
            SUBSTEPS,
            settings or dataclasses.replace(Settings(), iterations=1),
        )

    def replan(self, index: int, bend_angles: ArrayLike, rates: ArrayLike) -> Vector:
        """Return new commands (H, M) [Pa] from setpoint ``index`` on, and keep them.

        Args:
            index: of the first setpoint that may still change.
            bend_angles: (M,) of the limb when that setpoint takes effect [rad].
            rates: (M,) [rad/s].

        Raises:
            PlanningError: the index lies outside the plan, or the state is not finite.
        """
        count, inputs = self.commands.shape
        if not 0 <= index < count:
            raise PlanningError(f"setpoint {index} is not one of the plan's {count}")
        angles, speed = np.asarray(bend_angles, dtype=float), np.asarray(rates, dtype=float)
        finite = np.all(np.isfinite(angles)) and np.all(np.isfinite(speed))
        if angles.shape != (inputs,) or speed.shape != (inputs,) or not finite:
            raise PlanningError(
                f"expected {inputs} finite bend angles and rates, got {bend_angles!r}, {rates!r}"
            )
        last = min(index + self.horizon, count)
        self._solver.improve(self.commands, self._model.state(angles, speed), index, last)
        return self.commands[index:last].copy()
