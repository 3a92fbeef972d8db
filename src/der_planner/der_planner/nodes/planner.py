"""The planner node: motion commands and paths in, a latched plan and timed setpoints out."""

from __future__ import annotations

import dataclasses
import queue
import sys
import threading
import time as clock
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from nav_msgs.msg import Path as PathMessage
from numpy.typing import NDArray
from rclpy.node import Node
from std_srvs.srv import Trigger

from der_msgs.msg import LimbState, MotionCommand, PressureState
from der_planner.control.feedback import Feedback
from der_planner.control.knowledge import Estimate
from der_planner.nodes.driver_watch import DriverWatch, Ending
from der_planner.nodes.planner_action import MotionAction
from der_planner.nodes.planner_feedback import Corrector, Done
from der_planner.nodes.planner_making import PlanMaker
from der_planner.nodes.planner_parameters import PlannerOptions, read_parameters
from der_planner.nodes.planner_publishers import PlannerPublishers
from der_planner.nodes.planner_requests import Request, from_command, from_path, new_plan_id
from der_planner.nodes.planner_stage import Stage
from der_planner.nodes.planner_status import PlannerStatus
from der_planner.planning import Plan
from der_planner.planning.streaming import Schedule
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.overrides import check_overrides
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import NANOSECONDS

Array = NDArray[np.float64]

_ARMING_PATIENCE = 0.5
"""[s] for the state of a driver that was armed just now to arrive."""


class Cancelled(Exception):  # noqa: N818 - not an error
    """A newer command or `stop` made this plan useless."""


class Obstructed(Exception):  # noqa: N818 - not an error
    """The driver takes no setpoints; the argument is the `Ending`."""


class PlannerNode(Node):
    """Plans in a thread of its own, streams from another, answers from the executor's."""

    def __init__(self) -> None:
        super().__init__("planner", namespace=topics.NAMESPACE)
        self._options = read_parameters(self)
        check_overrides(self)
        self._lock = threading.Lock()
        self._status = PlannerStatus()
        self._request: Request | None = None
        self._newest: tuple[str, Plan, bool] | None = None
        self._work: queue.SimpleQueue[Request | None] = queue.SimpleQueue()
        self._output = PlannerPublishers(self)
        self._diagnostics = DiagnosticsPublisher(self, self._health)
        self._driver = DriverWatch(clock.monotonic, self._options.driver_timeout)
        self._stage = Stage(self, self._driver, self._now, self._options.lead)
        self._corrector = Corrector(self, self._now)
        self._maker = PlanMaker(self._options, lambda: self._stage.position, self._now)
        self._action = MotionAction(self, self._take_command, self._stop_plan, self._stage.find)
        self._planning = threading.Thread(target=self._run, name="planning", daemon=True)
        self._planning.start()
        self.create_subscription(PressureState, topics.PRESSURE_STATE, self._on_driver, qos.STATES)
        self.create_subscription(
            LimbState, topics.LIMB_STATE, self._corrector.take_state, qos.STATES
        )
        self.create_subscription(MotionCommand, topics.COMMAND, self._on_command, qos.COMMANDS)
        self.create_subscription(PathMessage, topics.PATH, self._on_path, qos.COMMANDS)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_timer(0.1, self._show)

    # What comes in -------------------------------------------------------------------------

    def _on_driver(self, message: PressureState) -> None:
        self._stage.take_state(message)
        self._corrector.take_pressures(message)

    def _on_command(self, message: MotionCommand) -> None:
        self._take_command(message, lambda _: None)

    def _take_command(self, message: MotionCommand, begin: Callable[[str], None]) -> None:
        """Plan a command or refuse it; ``begin`` is told the plan's id before either."""
        wanted = message.plan_id
        if not wanted or self._is_busy(wanted):
            message.plan_id = new_plan_id()
        begin(message.plan_id)
        try:
            if wanted and message.plan_id != wanted:
                raise ValueError(
                    f"plan '{wanted}' is being planned or played: name another, or none"
                )
            if self._stage.is_spent(wanted):
                raise ValueError(
                    f"plan '{wanted}' was ended by the driver, which takes no more of it: give the "
                    "command another plan_id, or none"
                )
            request = from_command(message, self._current_options(), self._now())
        except ValueError as error:
            self._refuse(message.plan_id, str(error))
            return
        self._accept(request)

    def _current_options(self) -> PlannerOptions:
        """Return the parameters with what may be changed while the node runs as it is now."""

        def value(name: str) -> Any:
            return self.get_parameter(name).value

        return replace(
            self._options,
            nearest_path=bool(value("nearest_path")),
            payload=float(value("payload")),
            payload_at=float(value("payload_at")),
        )

    def _is_busy(self, plan_id: str) -> bool:
        """Tell whether a plan of this id is being planned or played."""
        with self._stage.lock:
            request = self._request
            planned = request is not None and request.plan_id == plan_id
            return planned or self._stage.find(plan_id) is not None

    def _on_path(self, message: PathMessage) -> None:
        plan_id = new_plan_id()
        try:
            request = from_path(message, plan_id, self._current_options(), self._now())
        except (ValueError, IndexError) as error:
            self._refuse(plan_id, str(error))
            return
        self._accept(request)

    def _on_start(self, _: Any, response: Any) -> Any:
        """Play the newest plan, again if it was played before."""
        with self._lock:
            newest = self._newest
        position = self._stage.position
        obstacle = self._driver.obstacle()
        if newest is None:
            response.message = "no plan yet: ask for a motion first"
        elif position is not None:
            response.message = f"plan {position[0].plan_id} is being played: stop it first"
        elif newest[1].reference.start is not None:
            response.message = f"plan {newest[0]} began in another motion: ask for its own again"
        elif obstacle is not None:
            response.message = obstacle.reason
        else:
            plan_id, result, corrected = newest
            feedback = Feedback(result) if corrected else None
            schedule = self._play(self._stage.unspent(plan_id), result, 0, feedback)
            response.success = True
            ahead = (schedule.start - self._now()) / NANOSECONDS
            response.message = (
                f"plays plan {schedule.plan_id} ({result.motion}) for {result.duration:.0f} s, "
                f"beginning in {max(ahead, 0.0):.1f} s"
            )
        return response

    def _on_stop(self, _: Any, response: Any) -> Any:
        """Cancel planning and streaming; the driver holds, then vents."""
        planning, playing = self._end_all("stopped", "it was asked to stop")
        self._status.set("idle", reason="stopped as asked")
        response.success = True
        response.message = {
            (True, True): "cancelled the plan in the making and stopped streaming",
            (True, False): "cancelled the plan in the making",
            (False, True): "stopped streaming",
            (False, False): "nothing was running",
        }[(planning, playing)]
        return response

    def _stop_plan(self, plan_id: str) -> None:
        """Stop as the service does, if this plan is still planned or played."""
        with self._stage.lock:
            if self._is_busy(plan_id):
                self._end_all("stopped", "the action was cancelled")
                self._status.set("idle", reason="stopped by a cancelled action")

    # Ends ----------------------------------------------------------------------------------

    def _end_all(self, outcome: str, reason: str) -> tuple[bool, bool]:
        """Cancel planning, stop streaming; tell whether there was either."""
        with self._stage.lock:
            request = self._request
            if request is not None:
                request.cancelled.set()
            playing = self._stage.stop(outcome, reason)
        if request is not None:
            self._action.end(request.plan_id, outcome, reason)
        return request is not None, playing

    def abandoned(self, plan_id: str, ending: Ending) -> None:
        """Everything was stopped because of the driver: plan nothing to go on with either."""
        self._end_all(ending.outcome, ending.reason)
        self._status.set(ending.outcome, plan_id, reason=ending.reason)
        self._diagnostics.publish()

    def ended(self, schedule: Schedule, outcome: str, reason: str) -> None:
        """Log how the playing of a plan ended, and tell who asked for it."""
        current = self._status.read()[:2] == (schedule.plan_id, "streaming")
        if outcome == "finished" and current:
            self._status.set("done", schedule.plan_id, progress=1.0)
        text = f"plan {schedule.plan_id} {outcome} after {self._stage.share(schedule)}"
        if outcome in ("vented", "fault", "lost"):
            self.get_logger().error(f"{text}: {reason}")
        else:
            self.get_logger().info(f"{text}: {reason}" if reason else text)
        self._corrector.forget(schedule)
        self._action.end(schedule.plan_id, outcome, reason)

    def _refuse(self, plan_id: str, reason: str) -> None:
        """Refuse a plan; what is being planned or played meanwhile stays the state of the node."""
        self.get_logger().warning(f"plan {plan_id} refused: {reason}")
        self._status.refused(f"plan {plan_id}: {reason}")
        with self._lock:
            planned = self._request is not None and self._request.plan_id != plan_id
        if not planned and not self._stage.busy:
            self._status.set("refused", plan_id, reason=reason)
        self._action.end(plan_id, "refused", reason)
        self._diagnostics.publish()

    # Planning ------------------------------------------------------------------------------

    def _accept(self, request: Request) -> None:
        with self._lock:
            replaced, self._request = self._request, request
        self._status.refused("")
        if replaced is not None:
            replaced.cancelled.set()
            self._action.end(replaced.plan_id, "replaced", f"by plan {request.plan_id}")
        self.get_logger().info(
            f"plan {request.plan_id} accepted: {request.motion.name}, {request.model} "
            f"{request.method}"
        )
        self._status.set("planning", request.plan_id, progress=0.0)
        self._work.put(request)

    def _run(self) -> None:
        self._warm_up()
        while True:
            request = self._work.get()
            if request is None:
                return
            try:
                self._plan(request)
                failure = ""
            except Cancelled:
                self.get_logger().info(f"plan {request.plan_id} was cancelled")
                failure = ""
            except Obstructed as error:
                failure = f"planned, but not played: {error.args[0].reason}"
            except Exception as error:  # every failure becomes a refusal with its reason
                failure = str(error) or type(error).__name__
            with self._lock:
                if self._request is request:
                    self._request = None
            if failure and not request.cancelled.is_set():
                self._refuse(request.plan_id, failure)

    def _warm_up(self) -> None:
        """Compile every kernel before the node says that it is ready."""
        try:
            self._maker.warm_up()
        except Exception as error:
            self.get_logger().error(f"the limb cannot be planned for: {error}")
            self._status.set("error", reason=str(error))
            return
        self._status.ready()

    def _plan(self, request: Request) -> None:
        def progress(share: float) -> None:
            if request.cancelled.is_set():
                raise Cancelled
            self._status.progress = share

        stamp, start, result = self._maker.make(request, progress)
        feedback = Feedback(result) if request.feedback else None
        if feedback is not None:
            result = dataclasses.replace(result, method=f"{result.method} + feedback")
        for warning in result.warnings:
            self.get_logger().warning(f"plan {request.plan_id}: {warning}")
        with self._lock:
            self._newest = (request.plan_id, result, request.feedback)
        if self._options.auto_start:
            obstacle = self._driver.wait(_ARMING_PATIENCE)
            if obstacle is not None:
                raise Obstructed(obstacle)
            begin = stamp if start is not None else request.start
            self._play(request.plan_id, result, begin, feedback, request.cancelled)
        else:
            self._output.plan(Schedule(request.plan_id, result, 0))
            self._status.set("done", request.plan_id, reason="waits to be started", progress=1.0)

    # Streaming -----------------------------------------------------------------------------

    def _play(
        self,
        plan_id: str,
        result: Plan,
        start: int,
        feedback: Feedback | None,
        cancelled: threading.Event | None = None,
    ) -> Schedule:
        with self._stage.lock:
            if cancelled is not None and cancelled.is_set():
                raise Cancelled
            schedule = self._stage.play(plan_id, result, start)
            if feedback is not None:
                self._corrector.follow(schedule, feedback)
            return schedule

    def scheduled(self, schedule: Schedule) -> None:
        """A plan has its instant: publish it before its first setpoint."""
        result = schedule.plan
        self._status.set(
            "streaming", schedule.plan_id, reason="; ".join(result.warnings), progress=0.0
        )
        self._output.plan(schedule)
        ahead = (schedule.start - self._now()) / NANOSECONDS
        self.get_logger().info(
            f"plan {schedule.plan_id} planned in {result.solve_time:.2f} s: {schedule.count} "
            f"setpoints over {result.time[-1]:.1f} s, the first in {ahead:.2f} s"
        )

    def send(self, schedule: Schedule, index: int) -> None:
        """Publish one setpoint and where the tip should be at its instant."""
        if index == 0:
            self.get_logger().info(f"plan {schedule.plan_id} started")
        pressures = self._corrector.pressures(schedule, index)
        self._output.setpoint(schedule, index, pressures)
        self._output.reference(schedule, index)
        self._status.progress = (index + 1) / schedule.count

    def revise(self, schedule: Schedule, index: int, pressures: Array, revision: int) -> None:
        """Publish a setpoint that was sent already with other pressures (M,) [Pa]."""
        self._output.setpoint(schedule, index, pressures, revision)

    def estimated(self, schedule: Schedule, instant: int, estimate: Estimate, done: Done) -> None:
        """Publish what feedback knows of the limb at an instant [ns]."""
        self._output.estimate(schedule, instant, estimate, done)

    def warn(self, text: str) -> None:
        """Say that feedback was taken back."""
        self.get_logger().warning(text)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    # What it says of itself ----------------------------------------------------------------

    def _health(self) -> Health:
        with self._lock:
            newest = None if self._newest is None else self._newest[1]
        values = {
            "limb": self._options.limb.name,
            "driver": self._driver.mode or "not heard",
            "feedback": self._corrector.reason,
            "learned_plans": self._options.learned_plans,
        }
        return self._status.health(newest, values)

    def _show(self) -> None:
        """Ten times a second: end what is over, tell who asked, show the reference limb."""
        self._stage.end_what_is_over()
        self._action.tell(*self._status.read())
        position = self._stage.position
        if position is not None:
            self._output.reference_limb(*position, self._options.lead)

    def close(self) -> None:
        """Stop streaming and planning; called once before the node goes."""
        self._end_all("stopped", "the planner was ended")
        self._stage.close()
        self._corrector.close()
        self._work.put(None)


def main() -> None:
    """Entry point of `ros2 run der_planner planner`."""
    sys.exit(run_node(PlannerNode))


if __name__ == "__main__":
    main()
