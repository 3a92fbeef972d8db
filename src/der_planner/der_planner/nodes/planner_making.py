"""Makes the plans that the node was asked for, also from out of a motion that is being played."""

from __future__ import annotations

import time as clock
from collections.abc import Callable

from der_planner.control.feedback import Feedback
from der_planner.nodes.planner_parameters import PlannerOptions
from der_planner.nodes.planner_requests import Request
from der_planner.planning import METHODS, Motion, Plan, Start, plan
from der_planner.planning.streaming import Schedule, first_stamp

_MARGIN = 100_000_000
"""A plan starts this much [ns] after the earliest instant, so that its message travels first."""
_FEEDBACK_MARGIN = 500_000_000
"""What feedback needs to be made ready for a plan takes less than this [ns]."""


class PlanMaker:
    """Plans a requested motion so that it begins where the limb will then be.

    Args:
        options: of the node.
        position: returns the schedule in force and the index of its next setpoint, or None.
        now: present ROS time [ns].
    """

    def __init__(
        self,
        options: PlannerOptions,
        position: Callable[[], tuple[Schedule, int] | None],
        now: Callable[[], int],
    ) -> None:
        self._options, self._position, self._now = options, position, now

    def warm_up(self) -> None:
        """Compile every kernel, so that no plan has to wait for it.

        Raises:
            Exception: the limb cannot be planned for.
        """
        quick = Motion.named("asynchronous", amplitude=0.1, period=2.0, cycles=1)
        for model, methods in METHODS.items():
            for method in methods:
                found = plan(self._options.limb, quick, model, method, nodes=self._options.nodes)
        # The last of them has compiled whatever feedback calls as well.
        Feedback(found)

    def make(
        self, request: Request, progress: Callable[[float], None]
    ) -> tuple[int, Start | None, Plan]:
        """Return when a plan can take over, where the limb is then (None: at rest), and the plan.

        A motion that is being played goes on meanwhile; the new one takes over where it then is. If
        planning took too long for that, the plan is made again from a later instant.

        Args:
            request: what is asked for.
            progress: is told the share that is done; what it raises ends the planning.

        Raises:
            ValueError: it cannot be planned; says why.
        """
        spare = _FEEDBACK_MARGIN if request.feedback else 0
        allowance = _MARGIN + spare
        while True:
            progress(0.0)
            begun = clock.monotonic()
            stamp, start = self._hand_over(request.start, allowance)
            if request.learned is not None:
                if start is not None:
                    raise ValueError("a learned plan begins at rest: send it after this motion")
                return stamp, start, request.learned
            result = plan(
                request.limb, request.motion, request.model, request.method,
                nodes=self._options.nodes, start=start, progress=progress,
            )  # fmt: skip
            progress(1.0)
            if start is None or stamp - self._options.lead - spare > self._now():
                return stamp, start, result
            allowance = 2 * round((clock.monotonic() - begun) * 1e9) + spare + _MARGIN

    def _hand_over(self, wanted: int, allowance: int) -> tuple[int, Start | None]:
        """Return when a plan of now can take over, and where the limb is then; None: at rest."""
        stamp = first_stamp(self._now() + allowance, self._options.lead, wanted)
        position = self._position()
        return stamp, None if position is None else position[0].leave(stamp)
