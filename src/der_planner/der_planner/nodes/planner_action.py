"""The action `planner/play_motion`: a command whose sender is told how it goes and how it ended."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node

from der_msgs.action import PlayMotion
from der_msgs.msg import LimbState, MotionCommand
from der_planner.planning.streaming import GRID, Schedule
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds


@dataclass
class _Goal:
    """One goal, and how far the tracked tip was from the reference so far."""

    handle: ServerGoalHandle
    errors_sum: float = 0.0
    errors: int = 0

    @property
    def tip_error(self) -> float:
        """Mean distance [m]; NaN while no tip was tracked."""
        return self.errors_sum / self.errors if self.errors else math.nan


class MotionAction:
    """Serves the action. The planner plans and plays; this keeps who asked and tells them.

    A goal stays ACCEPTED until it ends: rclpy's executor spins without rest while a callback waits,
    so no callback waits here.

    Args:
        node: the planner.
        begin: takes a command, returns the id of its plan.
        stop: ends the plan of an id.
        schedule: returns the schedule of a plan that is being played, or None.
    """

    def __init__(
        self,
        node: Node,
        begin: Callable[[MotionCommand, Callable[[str], None]], None],
        stop: Callable[[str], None],
        schedule: Callable[[str], Schedule | None],
    ) -> None:
        self._begin, self._stop, self._schedule = begin, stop, schedule
        self._lock = threading.Lock()
        self._goals: dict[str, _Goal] = {}
        self._server = ActionServer(
            node,
            PlayMotion,
            "~/play_motion",
            execute_callback=self._conclude_unknown,
            handle_accepted_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )
        node.create_subscription(LimbState, topics.LIMB_STATE, self._on_limb, qos.STATES)

    def _on_goal(self, handle: ServerGoalHandle) -> None:
        def keep(plan_id: str) -> None:
            with self._lock:
                self._goals[plan_id] = _Goal(handle)

        self._begin(handle.request.command, keep)

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        with self._lock:
            found = [name for name, goal in self._goals.items() if goal.handle == handle]
        for plan_id in found:
            # The answer to the cancel request must be out before the goal ends.
            threading.Timer(0.05, self._stop, [plan_id]).start()
        return CancelResponse.ACCEPT if found else CancelResponse.REJECT

    def _on_limb(self, state: LimbState) -> None:
        """Compare the tracked tip with the reference at the stamp of its image."""
        if not self._goals or not state.valid:
            return
        stamp = nanoseconds(state.header.stamp)
        with self._lock:
            goals = list(self._goals.items())
        for plan_id, goal in goals:
            schedule = self._schedule(plan_id)
            if schedule is None or not schedule.start <= stamp <= schedule.stamp(
                schedule.count - 1
            ):
                continue
            at = (stamp - schedule.start) / GRID
            rows = np.arange(schedule.count)
            x, y = (np.interp(at, rows, schedule.plan.tip_reference[:, axis]) for axis in (0, 1))
            goal.errors_sum += math.hypot(state.tip.x - x, state.tip.y - y)
            goal.errors += 1

    def tell(self, plan_id: str, state: str, progress: float) -> None:
        """Publish feedback to who asked for a plan, if anybody did."""
        with self._lock:
            goal = self._goals.get(plan_id)
        if goal is not None:
            goal.handle.publish_feedback(
                PlayMotion.Feedback(state=state, progress=progress, tip_error=goal.tip_error)
            )

    def end(self, plan_id: str, outcome: str, reason: str) -> None:
        """Give who asked for a plan its result; may be called from any thread, and twice."""
        with self._lock:
            goal = self._goals.pop(plan_id, None)
        if goal is None:
            return
        result = PlayMotion.Result(
            outcome=outcome, reason=reason, plan_id=plan_id, tip_error=goal.tip_error
        )

        def conclude(handle: ServerGoalHandle) -> Any:
            if handle.is_cancel_requested:
                handle.canceled()
            elif outcome == "finished":
                handle.succeed()
            else:
                handle.abort()
            return result

        goal.handle.execute(conclude)

    def _conclude_unknown(self, handle: ServerGoalHandle) -> Any:
        handle.abort()
        return PlayMotion.Result(outcome="failed", reason="the goal was executed by nobody")

    def close(self) -> None:
        """End the server."""
        self._server.destroy()
