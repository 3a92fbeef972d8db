"""The planner node: motion commands and paths in, a latched plan and timed setpoints out."""

from __future__ import annotations

import dataclasses
import queue
import threading
import time as clock
from typing import Any

from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from std_srvs.srv import Trigger

from der_msgs.msg import LimbState, MotionCommand, PressureState
from der_planner.control.feedback import Feedback
from der_planner.nodes.planner_feedback import Corrector, warm_up
from der_planner.nodes.planner_requests import (
    Cancelled,
    MotionAction,
    Request,
    from_command,
    from_path,
    identified,
    new_plan_id,
    read_parameters,
)
from der_planner.nodes.planner_topics import DriverWatch, PlannerPublishers, Status, told_of
from der_planner.planning import Plan, plan
from der_planner.planning.streaming import MARGIN, Ending, Schedule, Streamer, first_stamp
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import NANOSECONDS

_ARMING_PATIENCE = 0.5
"""The state of a driver that was armed just now is waited for this long [s]."""
_FEEDBACK_MARGIN = 500_000_000
"""Making feedback ready for a plan takes less than this [ns]."""
_BY_DRIVER = ("vented", "fault", "lost")
"""How a plan ends that the driver takes no more of."""


class PlannerNode(Node):
    """Plans in a thread of its own, streams from another, answers from the executor's."""

    def __init__(self) -> None:
        super().__init__("planner", namespace=topics.NAMESPACE)
        self._options = read_parameters(self)
        check_overrides(self)
        self._status = Status()
        self._progress = 0.0  # share of the planning or of the playing that is done
        self._last_refusal = ""
        self._request: Request | None = None
        self._asked = 0  # when a motion was asked for last [ns]
        self._newest: tuple[str, Plan, bool] | None = None
        self._work: queue.SimpleQueue[Request | None] = queue.SimpleQueue()
        self._output = PlannerPublishers(self)
        self._diagnostics = DiagnosticsPublisher(self, self._health)
        self._driver = DriverWatch(clock.monotonic, self._options.driver_timeout)
        self._streamer = Streamer(
            self._now, self._send, self._ended, self._driver.obstacle, self._options.lead
        )
        vent = self.create_client(Trigger, "pressure_driver/vent").call_async
        self._corrector = Corrector(self._output, self.get_logger().warning, self._now, vent)
        self._action = MotionAction(
            self, self._checked, self._accept, self._stop_plan, self._streamer.find
        )
        threading.Thread(target=self._run, name="planning", daemon=True).start()
        self.create_subscription(PressureState, topics.PRESSURE_STATE, self._on_driver, qos.STATES)
        self.create_subscription(LimbState, topics.LIMB_STATE, self._on_limb, qos.STATES)
        self.create_subscription(MotionCommand, topics.COMMAND, self._on_command, qos.COMMANDS)
        self.create_subscription(PathMessage, topics.PATH, self._on_path, qos.COMMANDS)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_timer(0.1, self._show)

    # What comes in -------------------------------------------------------------------------

    def _on_driver(self, message: PressureState) -> None:
        ending = self._driver.update(message, self._streamer.begun, self._asked)
        if ending is not None:
            self._streamer.abandon(ending)
            self._drop_request(ending)
        elif message.mode == message.ARMED and self._status.state in _BY_DRIVER:
            self._status = Status("idle", self._status.plan_id)  # what ended the plan is over
        self._corrector.add_pressures(message)

    def _on_limb(self, message: LimbState) -> None:
        self._corrector.add_state(message)
        self._action.compare(message)

    def _on_command(self, message: MotionCommand) -> None:
        if (request := self._checked(message)) is not None:
            self._accept(request)

    def _checked(self, message: MotionCommand) -> Request | None:
        """Return what a command asks for, with the id of its plan; None: refused, and said why."""
        wanted = message.plan_id
        if not wanted or self._is_busy(wanted):
            message.plan_id = new_plan_id()
        try:
            if wanted and message.plan_id != wanted:
                raise ValueError(
                    f"plan '{wanted}' is being planned or played: name another, or none"
                )
            if self._streamer.is_spent(wanted):
                raise ValueError(
                    f"plan '{wanted}' was ended by the driver, which takes no more of it: "
                    "give the command another plan_id, or none"
                )
            return from_command(message, self._options.as_now(self), self._now())
        except ValueError as error:
            self._refuse(message.plan_id, str(error))
            return None

    def _is_busy(self, plan_id: str) -> bool:
        """Tell whether a plan of this id is being planned or played."""
        with self._streamer.lock:
            request = self._request
            planned = request is not None and request.plan_id == plan_id
            return planned or self._streamer.find(plan_id) is not None

    def _on_path(self, message: PathMessage) -> None:
        plan_id = new_plan_id()
        try:
            self._accept(from_path(message, plan_id, self._options.as_now(self), self._now()))
        except (ValueError, IndexError) as error:
            self._refuse(plan_id, str(error))

    def _on_start(self, _: Any, response: Any) -> Any:
        """Play the newest plan, again if it was played before."""
        newest, position = self._newest, self._streamer.position
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
            feedback = self._options.corrected(result) if corrected else None
            name = self._streamer.unspent(plan_id)
            self._play(name, result, 0, feedback)
            response.success = True
            response.message = f"plays plan {name} ({result.motion}) for {result.duration:.0f} s"
        return response

    def _on_stop(self, _: Any, response: Any) -> Any:
        """Cancel planning and streaming; the driver holds, then vents."""
        planning, playing = self._end_all("stopped", "stopped as asked")
        ended = ["cancelled the plan in the making"] * planning + ["stopped streaming"] * playing
        response.success = True
        response.message = " and ".join(ended) or "nothing was running"
        return response

    def _stop_plan(self, plan_id: str) -> None:
        """Stop as the service does, if this plan is still planned or played."""
        with self._streamer.lock:
            if self._is_busy(plan_id):
                self._end_all("stopped", "the action was cancelled")

    # Planning ------------------------------------------------------------------------------

    def _accept(self, request: Request) -> None:
        # A driver that has died says nothing more on which the request could be dropped.
        obstacle = self._driver.obstacle() if self._options.auto_start else None
        if obstacle is not None and obstacle.outcome == "lost":
            self._refuse(request.plan_id, obstacle.reason)
            return
        with self._streamer.lock:
            replaced, self._request, self._asked = self._request, request, request.asked
        self._last_refusal = ""
        if replaced is not None:
            replaced.cancelled.set()
            self._action.end(replaced.plan_id, "replaced", f"by plan {request.plan_id}")
        asked = f"{request.motion.name}, {request.model} {request.method}"
        self.get_logger().info(f"plan {request.plan_id} accepted: {asked}")
        self._status = Status("planning", request.plan_id)
        self._diagnostics.publish()
        self._work.put(request)

    def _drop_request(self, ending: Ending) -> None:
        """Refuse what was asked for before the driver took nothing.

        A request belongs to the arming in which it was made: it never plays after a later one.
        """
        with self._streamer.lock:
            request = self._request
            # Without auto_start it is only planned, and waits to be started.
            if request is None or not self._options.auto_start or request.cancelled.is_set():
                return
            request.cancelled.set()
            self._request = None
        self._refuse(request.plan_id, ending.reason)

    def _refuse(self, plan_id: str, reason: str) -> None:
        """Refuse a plan; what is being planned or played meanwhile stays the state of the node."""
        self.get_logger().warning(f"plan {plan_id} refused: {reason}")
        self._last_refusal = f"plan {plan_id}: {reason}"
        request = self._request
        planned = request is not None and request.plan_id != plan_id
        if not planned and not self._streamer.busy:
            self._status = Status("refused", plan_id, reason)
        self._action.end(plan_id, "refused", reason)
        self._diagnostics.publish()

    def _run(self) -> None:
        """Plan one request after the other; every failure becomes a refusal with its reason."""
        try:
            warm_up(self._options.limb, self._options.nodes)
            if self._status == Status():
                self._status = Status("idle")
        except Exception as error:
            self.get_logger().error(f"the limb cannot be planned for: {error}")
            self._status = Status("error", reason=str(error))
        while (request := self._work.get()) is not None:
            failure = ""
            try:
                self._plan(request)
            except Cancelled:
                self.get_logger().info(f"plan {request.plan_id} was cancelled")
            except Exception as error:
                failure = str(error) or type(error).__name__
            with self._streamer.lock:
                if self._request is request:
                    self._request = None
            if failure and not request.cancelled.is_set():
                self._refuse(request.plan_id, failure)

    def _plan(self, request: Request) -> None:
        """Plan what was asked for and play it.

        Raises:
            ValueError: it cannot be planned, or not be played; says why.
        """
        if request.cancelled.is_set():
            raise Cancelled
        self._status = Status("planning", request.plan_id)
        stamp, result = self._make(request)
        feedback = self._options.corrected(result) if request.feedback else None
        if feedback is not None:
            result = dataclasses.replace(result, method=f"{result.method} + feedback")
        for warning in result.warnings:
            self.get_logger().warning(f"plan {request.plan_id}: {warning}")
        self._newest = (request.plan_id, result, request.feedback)
        if not self._options.auto_start:
            self._output.plan(Schedule(request.plan_id, result, 0))
            self._status = Status("done", request.plan_id, "waits to be started")
            return
        if (obstacle := self._driver.wait(_ARMING_PATIENCE)) is not None:
            raise ValueError(f"planned, but not played: {obstacle.reason}")
        self._play(request.plan_id, result, stamp, feedback, request.cancelled)

    def _make(self, request: Request) -> tuple[int, Plan]:
        """Return when a plan can begin [ns], and the plan.

        A motion that is being played goes on meanwhile; the new one takes over where it then is. If
        planning took too long for that, the plan is made again from a later instant.

        Raises:
            ValueError: it cannot be planned; says why.
        """

        def progress(share: float) -> None:
            if request.cancelled.is_set():
                raise Cancelled
            self._progress = share

        lead, spare = self._options.lead, _FEEDBACK_MARGIN if request.feedback else 0
        allowance = MARGIN + spare
        while True:
            progress(0.0)
            begun = clock.monotonic()
            stamp = first_stamp(self._now() + allowance, lead, request.start)
            position = self._streamer.position
            start = None if position is None else position[0].leave(stamp)
            result = request.learned
            if result is None:
                result = plan(
                    request.limb, request.motion, request.model, request.method,
                    nodes=self._options.nodes, start=start, progress=progress,
                    obstacles=self._options.in_the_way,
                )  # fmt: skip
            elif start is not None:
                raise ValueError("a learned plan begins at rest: send it after this motion")
            progress(1.0)
            if start is None:
                return request.start, result
            if stamp - lead - spare > self._now():
                return stamp, result
            allowance = 2 * round((clock.monotonic() - begun) * NANOSECONDS) + spare + MARGIN

    # Streaming -----------------------------------------------------------------------------

    def _play(
        self,
        plan_id: str,
        result: Plan,
        start: int,
        feedback: Feedback | None,
        cancelled: threading.Event | None = None,
    ) -> None:
        with self._streamer.lock:
            if cancelled is not None and cancelled.is_set():
                raise Cancelled
            schedule = self._streamer.play(plan_id, result, start)
            if feedback is not None:
                self._corrector.follow(schedule, feedback)
            self._status = Status("streaming", plan_id, "; ".join(result.warnings))
            self._progress = 0.0
            self._driver.newly_refused()
            self._output.plan(schedule)
        self.get_logger().info(
            f"plan {plan_id} planned in {result.solve_time:.2f} s: {schedule.count} setpoints over "
            f"{result.duration:.1f} s"
        )

    def _send(self, schedule: Schedule, index: int) -> None:
        """Publish one setpoint and where the tip should be at its instant."""
        if index == 0:
            self.get_logger().info(f"plan {schedule.plan_id} started")
        self._output.setpoint(schedule, index, self._corrector.pressures(schedule, index))
        self._output.reference(schedule, index)
        self._progress = (index + 1) / schedule.count

    def _end_all(self, outcome: str, reason: str) -> tuple[bool, bool]:
        """Cancel planning, stop streaming, say so; tell whether there was either."""
        with self._streamer.lock:
            request = self._request
            if request is not None:
                request.cancelled.set()
            playing = self._streamer.stop(outcome, reason)
        if request is not None:
            self._action.end(request.plan_id, outcome, reason)
        if outcome == "stopped":
            self._status = Status("idle", self._status.plan_id, reason)
        return request is not None, playing

    def _ended(self, schedule: Schedule, outcome: str, reason: str) -> None:
        """Log how the playing of a plan ended, and tell who asked for it."""
        if outcome == "finished" and (refused := self._driver.newly_refused()):
            reason = f"the driver refused {refused} setpoints meanwhile: its log says why"
        reason = "; ".join(filter(None, [self._corrector.forget(schedule), reason]))
        text = f"plan {schedule.plan_id} {outcome} after {self._streamer.share(schedule)}"
        if outcome in _BY_DRIVER:
            # The driver takes nothing: plan nothing to go on with either.
            self.get_logger().error(f"{text}: {reason}")
            self._end_all(outcome, reason)
            self._status = Status(outcome, schedule.plan_id, reason)
            self._diagnostics.publish()
        else:
            self.get_logger().info(f"{text}: {reason}" if reason else text)
            if outcome == "finished" and self._status[:2] == ("streaming", schedule.plan_id):
                self._status = Status("done", schedule.plan_id, reason)
        self._action.end(schedule.plan_id, outcome, reason)

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    # What it says of itself ----------------------------------------------------------------

    def _health(self) -> Health:
        values: dict[str, object] = {
            **self._status._asdict(),
            "last_refusal": self._last_refusal,
            "progress": f"{self._progress:.3f}",
            "limb": self._options.limb.name,
            "limb_file": self._options.limb_file,
            "limb_identified": identified(self._options.limb),
            "driver": self._driver.mode or "not heard",
            "feedback": self._corrector.reason,
            "learned_plans": self._options.learned_plans,
        }
        if self._newest is not None:
            values |= told_of(self._newest[1])
        return self._status.health(self._last_refusal, values)

    def _show(self) -> None:
        """Ten times a second: end what is over, tell who asked, show the reference limb."""
        self._streamer.end_what_is_over()
        self._action.tell(self._status.plan_id, self._status.state, self._progress)
        position = self._streamer.position
        if position is not None:
            self._output.reference_limb(*position, self._options.lead)

    def close(self) -> None:
        """Stop streaming and planning; called once before the node goes."""
        self._end_all("stopped", "the planner was ended")
        self._streamer.close()
        self._corrector.close()
        self._work.put(None)


def main() -> int:
    """Run the node."""
    return run_node(PlannerNode)
