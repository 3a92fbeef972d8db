"""The planner node: motion commands and paths in, a latched plan and timed setpoints out."""

from __future__ import annotations

import functools
import queue
import sys
import threading
import uuid
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PointStamped
from nav_msgs.msg import Path as PathMessage
from rclpy.node import Node
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from der_msgs.msg import MotionCommand, PressurePlan, PressureSetpoint
from der_planner.limb import Limb
from der_planner.nodes.planner_markers import limb_marker, path_markers
from der_planner.planning import METHODS, Motion, PathLimits, Plan, Start, choose_method, plan
from der_planner.planning.inverse import BRANCHES
from der_planner.planning.motions import DEFAULT_AMPLITUDE, DEFAULT_CYCLES, DEFAULT_PERIOD
from der_planner.planning.streaming import GRID, Player, Schedule, first_stamp
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import declare
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

_MARGIN = 100_000_000
"""A plan starts this much [ns] after the earliest instant, so that its message travels first."""


@dataclass
class Request:
    """One thing to plan: what was asked for, and whether it is still wanted."""

    plan_id: str
    motion: Motion
    model: str
    method: str
    start: int
    cancelled: threading.Event = field(default_factory=threading.Event)


class Cancelled(Exception):  # noqa: N818 - not an error
    """A newer command or `stop` made this plan useless."""


class PlannerNode(Node):
    """Plans in a thread of its own, streams from another, answers from the executor's."""

    def __init__(self) -> None:
        super().__init__("planner", namespace=topics.NAMESPACE)
        self._read_parameters()
        self._lock = threading.Lock()
        self._state, self._plan_id, self._reason, self._progress = "starting", "", "", 0.0
        self._request: Request | None = None
        self._newest: tuple[str, Plan] | None = None
        self._work: queue.SimpleQueue[Request | None] = queue.SimpleQueue()
        self._plans = self.create_publisher(PressurePlan, topics.PLAN, qos.LATCHED)
        self._setpoints = self.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )
        self._references = self.create_publisher(PointStamped, topics.TIP_REFERENCE, qos.STATES)
        self._markers = self.create_publisher(MarkerArray, topics.SHAPE_MARKERS, qos.STATES)
        self._diagnostics = DiagnosticsPublisher(self, self._health)
        self._player = Player(self._now, self._send, self._finished, self._lead)
        self._planning = threading.Thread(target=self._run, name="planning", daemon=True)
        self._planning.start()
        self.create_subscription(MotionCommand, topics.COMMAND, self._on_command, qos.COMMANDS)
        self.create_subscription(PathMessage, topics.PATH, self._on_path, qos.COMMANDS)
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_service(Trigger, "~/stop", self._on_stop)
        self.create_timer(0.1, self._show)

    def _read_parameters(self) -> None:
        read = functools.partial(declare, self)
        limb_file = str(read("limb_file", "", "limb file (YAML); empty: the default limb"))
        self._limb = Limb.from_yaml(limb_file) if limb_file else Limb.default()
        self._model = str(
            read("default_model", "der", "model for paths and for commands that name none",
                 choices=tuple(METHODS))
        )  # fmt: skip
        self._method = str(
            read("default_method", "", "method of the rod where none is named; empty: the best",
                 choices=("", *METHODS["der"]))
        )  # fmt: skip
        self._nodes = int(read("nodes", 21, "nodes of the rod", at_least=6, at_most=201))  # type: ignore[arg-type]
        lead = read("lead_time", 0.2, "time between sending a setpoint and its stamp [s]",
                    at_least=0.05, at_most=2.0)  # fmt: skip
        self._lead = round(float(lead) * 1e9)  # type: ignore[arg-type]
        self._auto_start = bool(read("auto_start", True, "play a plan as soon as it is ready"))
        self._branch = str(
            read("branch", "", "side of the fold for paths and shapes; empty: the least pressure",
                 choices=("", *BRANCHES))
        )  # fmt: skip
        self._limits = PathLimits(
            float(read("path_speed", 0.03, "speed along a path without times [m/s]",
                       at_least=1e-3, at_most=1.0)),  # type: ignore[arg-type]
            float(read("path_acceleration", 0.05, "acceleration along and across it [m/s^2]",
                       at_least=1e-3, at_most=10.0)),  # type: ignore[arg-type]
        )  # fmt: skip

    # What comes in -------------------------------------------------------------------------

    def _on_command(self, message: MotionCommand) -> None:
        plan_id = message.plan_id or uuid.uuid4().hex[:8]
        try:
            model = message.model or self._model
            motion = Motion.named(
                message.motion,
                amplitude=message.amplitude or DEFAULT_AMPLITUDE,
                period=message.period or DEFAULT_PERIOD,
                cycles=message.cycles or DEFAULT_CYCLES,
                branch=self._branch,
            )
            method = self._choose_method(model, message.method)
        except ValueError as error:
            self._refuse(plan_id, str(error))
            return
        start = nanoseconds(message.header.stamp)
        self._accept(Request(plan_id, motion, model, method, start))

    def _on_path(self, message: PathMessage) -> None:
        plan_id = uuid.uuid4().hex[:8]
        frame = message.header.frame_id
        try:
            if frame not in ("", topics.BASE_FRAME):
                raise ValueError(
                    f"the path is in frame '{frame}': send it in '{topics.BASE_FRAME}'"
                )
            tip = np.array([(p.pose.position.x, p.pose.position.y) for p in message.poses])
            stamps = [nanoseconds(pose.header.stamp) for pose in message.poses]
            time = (np.array(stamps) - stamps[0]) * 1e-9 if any(stamps) else None
            motion = Motion.from_tip_path(
                time, tip.reshape(-1, 2), branch=self._branch, limits=self._limits
            )
            method = self._choose_method(self._model, "")
        except (ValueError, IndexError) as error:
            self._refuse(plan_id, str(error))
            return
        start = nanoseconds(message.header.stamp)
        self._accept(Request(plan_id, motion, self._model, method, start))

    def _choose_method(self, model: str, method: str) -> str:
        return choose_method(model, method or (self._method if model == "der" else ""))

    def _on_start(self, _: Any, response: Any) -> Any:
        """Play the newest plan, again if it was played before."""
        with self._lock:
            newest = self._newest
        position = self._player.position
        response.success = newest is not None and position is None
        if newest is None:
            response.message = "no plan yet: publish a command first"
            return response
        if position is not None:
            response.message = f"plan {position[0].plan_id} is being played: call stop first"
            return response
        if newest[1].reference.start is not None:
            response.success = False
            response.message = (
                f"plan {newest[0]} began in another motion: publish its command again"
            )
            return response
        schedule = self._play(*newest, start=0)
        response.message = f"plan {schedule.plan_id} starts at {schedule.start * 1e-9:.2f} s"
        return response

    def _on_stop(self, _: Any, response: Any) -> Any:
        """Cancel planning and streaming; the driver holds, then vents."""
        with self._lock:
            planning = self._request is not None
            if self._request is not None:
                self._request.cancelled.set()
        playing = self._player.stop()
        self._set("idle", reason="stopped by the service stop")
        response.success = True
        response.message = {
            (True, True): "cancelled the plan in the making and stopped streaming",
            (True, False): "cancelled the plan in the making",
            (False, True): "stopped streaming",
            (False, False): "nothing was running",
        }[(planning, playing)]
        return response

    # Planning ------------------------------------------------------------------------------

    def _accept(self, request: Request) -> None:
        with self._lock:
            if self._request is not None:
                self._request.cancelled.set()
            self._request = request
        self._set("planning", request.plan_id, progress=0.0)
        self._work.put(request)

    def _refuse(self, plan_id: str, reason: str) -> None:
        self.get_logger().warning(f"plan {plan_id} refused: {reason}")
        self._set("refused", plan_id, reason=reason)
        self._diagnostics.publish()

    def _run(self) -> None:
        self._warm_up()
        while True:
            request = self._work.get()
            if request is None:
                return
            try:
                self._plan(request)
            except Cancelled:
                self.get_logger().info(f"plan {request.plan_id} was cancelled")
            except Exception as error:  # every failure becomes a refusal with its reason
                if not request.cancelled.is_set():
                    self._refuse(request.plan_id, str(error) or type(error).__name__)
            finally:
                with self._lock:
                    if self._request is request:
                        self._request = None

    def _warm_up(self) -> None:
        """Compile every kernel before the node says that it is ready."""
        try:
            quick = Motion.named("asynchronous", amplitude=0.1, period=2.0, cycles=1)
            for model, methods in METHODS.items():
                for method in methods:
                    plan(self._limb, quick, model, method, nodes=self._nodes)
        except Exception as error:
            self.get_logger().error(f"the limb cannot be planned for: {error}")
            self._set("error", reason=str(error))
            return
        with self._lock:
            waiting = self._state == "starting"
        if waiting:
            self._set("idle")

    def _plan(self, request: Request) -> None:
        def progress(share: float) -> None:
            if request.cancelled.is_set():
                raise Cancelled
            self._progress = share

        # A motion that is being played goes on meanwhile; the new one takes over where it then is.
        allowance = _MARGIN
        while True:
            progress(0.0)
            stamp, start = self._hand_over(request.start, allowance)
            result = plan(
                self._limb, request.motion, request.model, request.method, nodes=self._nodes,
                start=start, progress=progress,
            )  # fmt: skip
            progress(1.0)
            if start is None or stamp - self._lead > self._now():
                break
            allowance = 2 * round(result.solve_time * 1e9) + _MARGIN
        for warning in result.warnings:
            self.get_logger().warning(f"plan {request.plan_id}: {warning}")
        with self._lock:
            self._newest = (request.plan_id, result)
        if self._auto_start:
            self._play(request.plan_id, result, stamp if start is not None else request.start)
        else:
            self._publish_plan(Schedule(request.plan_id, result, 0))
            self._set("done", request.plan_id, reason="waits for the service start", progress=1.0)

    def _hand_over(self, wanted: int, allowance: int) -> tuple[int, Start | None]:
        """Return when a plan of now can take over, and where the limb is then; None: at rest."""
        stamp = first_stamp(self._now() + allowance, self._lead, wanted)
        position = self._player.position
        return stamp, None if position is None else position[0].leave(stamp)

    # Streaming -----------------------------------------------------------------------------

    def _play(self, plan_id: str, result: Plan, start: int) -> Schedule:
        earliest = first_stamp(self._now() + (_MARGIN if start == 0 else 0), self._lead, start)
        position = self._player.position
        if position is not None and result.reference.start is None:
            earliest = max(earliest, position[0].stamp(position[0].count))
        schedule = Schedule(plan_id, result, earliest)
        self._set("streaming", plan_id, reason="; ".join(result.warnings), progress=0.0)
        self._publish_plan(schedule)
        self._player.play(schedule)
        return schedule

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _send(self, schedule: Schedule, index: int) -> None:
        stamp = stamp_from_nanoseconds(schedule.stamp(index))
        setpoint = PressureSetpoint(plan_id=schedule.plan_id, index=index)
        setpoint.header.stamp = stamp
        setpoint.header.frame_id = topics.BASE_FRAME
        setpoint.differential_pressure = schedule.plan.differential_pressure[index].tolist()
        self._setpoints.publish(setpoint)
        x, y = schedule.plan.tip_reference[index]
        reference = PointStamped(point=Point(x=float(x), y=float(y)))
        reference.header = setpoint.header
        self._references.publish(reference)
        self._progress = (index + 1) / schedule.count

    def _finished(self, schedule: Schedule) -> None:
        with self._lock:
            current = self._plan_id == schedule.plan_id and self._state == "streaming"
        if current:
            self._set("done", schedule.plan_id, progress=1.0)

    def _publish_plan(self, schedule: Schedule) -> None:
        result = schedule.plan
        message = PressurePlan(
            plan_id=schedule.plan_id, motion=result.motion, model=result.model,
            method=result.method, amplitude=result.amplitude, period=result.period,
            cycles=result.cycles, limb=result.limb.name, segment_count=result.limb.segment_count,
            time=result.time.tolist(),
            differential_pressure=result.differential_pressure.ravel().tolist(),
            tip_reference=result.tip_reference.ravel().tolist(),
            tip_predicted=result.tip_predicted.ravel().tolist(),
            solve_time=result.solve_time, predicted_error=result.predicted_error,
        )  # fmt: skip
        message.header.stamp = stamp_from_nanoseconds(schedule.start)
        message.header.frame_id = topics.BASE_FRAME
        self._plans.publish(message)
        self._markers.publish(path_markers(result, self.get_clock().now().to_msg()))

    # What it says of itself ----------------------------------------------------------------

    def _set(
        self,
        state: str,
        plan_id: str | None = None,
        reason: str = "",
        progress: float | None = None,
    ) -> None:
        with self._lock:
            self._state, self._reason = state, reason
            self._plan_id = self._plan_id if plan_id is None else plan_id
            self._progress = self._progress if progress is None else progress

    def _health(self) -> Health:
        with self._lock:
            values = {
                "state": self._state,
                "plan_id": self._plan_id,
                "reason": self._reason,
                "progress": f"{self._progress:.3f}",
                "limb": self._limb.name,
            }
            newest = self._newest
        if newest is not None:
            values["predicted_error_m"] = f"{newest[1].predicted_error:.6f}"
            values["pressure_margin_pa"] = f"{newest[1].pressure_margin:.0f}"
            values["slew_margin_pa_per_s"] = f"{newest[1].slew_margin:.0f}"
            values["solve_time_s"] = f"{newest[1].solve_time:.3f}"
        if self._state == "starting":
            return Health("stale", "waiting for the models to compile", values)
        if self._state == "error":
            return Health("error", self._reason, values)
        if self._state == "refused":
            return Health("warning", f"refused: {self._reason}", values)
        level = "warning" if self._state == "streaming" and self._reason else "ok"
        return Health(level, self._reason or self._state, values)

    def _show(self) -> None:
        """Publish the reference limb of the setpoint in force, ten times a second."""
        position = self._player.position
        if position is None:
            return
        schedule, index = position
        index = max(0, index - 1 - self._lead // GRID)
        stamp = self.get_clock().now().to_msg()
        self._markers.publish(limb_marker(schedule.plan, index, stamp))

    def close(self) -> None:
        """Stop streaming and planning; called once before the node goes."""
        with self._lock:
            if self._request is not None:
                self._request.cancelled.set()
        self._player.close()
        self._work.put(None)


def main() -> None:
    """Entry point of `ros2 run der_planner planner`."""
    sys.exit(run_node(PlannerNode))


if __name__ == "__main__":
    main()
