"""What the page's buttons do to the graph: the services and topics that a terminal would use."""

from __future__ import annotations

import json
import time
import uuid
from concurrent.futures import Future
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from std_srvs.srv import Trigger

from der_msgs.msg import MotionCommand, PressureSetpoint
from der_planner.page.commands import FILLING, OWNERS, Answer, Conditions, MotionRequest, Service
from der_planner.page.situation import NANOSECONDS, Situation
from der_planner.planning.plan_file import learned_names
from limb_interfaces import qos, topics
from limb_interfaces.stamps import stamp_from_nanoseconds

PATHS: dict[Service, str] = {
    "vent": "pressure_driver/vent",
    "arm": "pressure_driver/arm",
    "start": "planner/start",
    "stop": "planner/stop",
    "record_start": "recorder/start",
    "record_stop": "recorder/stop",
}

TICK = NANOSECONDS // 20
"""[ns] between two setpoints."""
RECORDER = "recorder"
"""The node that listens to commands without following them."""
FILL_AHEAD = 4
"""Ticks from now to the first setpoint."""


class GraphCommands:
    """`Commands` by ROS; called from the server's thread, answered from the executor's.

    Args:
        node: of the page.
        situation: what the nodes have said of themselves.
        segments: of the limb.
    """

    def __init__(self, node: Node, situation: Situation, segments: int) -> None:
        self._node = node
        self._situation = situation
        self._segments = segments
        self._service_clients = {
            service: node.create_client(Trigger, path) for service, path in PATHS.items()
        }
        self._recorder_parameters = node.create_client(SetParameters, "recorder/set_parameters")
        self._setpoints = node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )
        self._motions = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)

    def call(self, service: Service) -> Future[Answer]:
        """Call a service of the driver, the planner or the recorder."""
        answer: Future[Answer] = Future()
        client = self._service_clients[service]
        if not client.service_is_ready():
            text = f"{OWNERS[service]} does not run or cannot be reached"
            if service == "vent":
                text += ": NOT VENTED; close the supply and open the valves by hand"
            answer.set_result(Answer(False, text))
            return answer

        def finish(pending: Any) -> None:
            if answer.cancelled():
                return
            result = pending.result()
            answer.set_result(Answer(bool(result.success), result.message))

        client.call_async(Trigger.Request()).add_done_callback(finish)
        return answer

    def play(self, request: MotionRequest) -> Answer:
        """Publish a motion command; the planner's answer is seen in its diagnostics."""
        message = MotionCommand(
            motion=request.motion, amplitude=request.amplitude, period=request.period,
            cycles=request.cycles,
        )  # fmt: skip
        return self._command(message, request.conditions, request.motion)

    def record(self, note: str) -> Future[Answer]:
        """Start the recorder with the note in the bag's metadata."""
        answer: Future[Answer] = Future()
        if not self._recorder_parameters.service_is_ready():
            answer.set_result(Answer(False, "recorder does not run or cannot be reached"))
            return answer

        def then(pending: Any) -> None:
            result = pending.result().results[0]
            if not result.successful:
                answer.set_result(Answer(False, result.reason))
                return
            self.call("record_start").add_done_callback(
                lambda done: answer.set_result(done.result())
            )

        metadata = ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value=json.dumps({"note": note})
        )
        request = SetParameters.Request(parameters=[Parameter(name="metadata", value=metadata)])
        self._recorder_parameters.call_async(request).add_done_callback(then)
        return answer

    def fill(self, segment: int, side: int, pressure: float) -> Answer:
        """Send the driver setpoints for one chamber, if it is armed and nothing is played."""
        mode = self._situation.driver_mode
        if mode != "armed":
            return Answer(
                False, f"the driver is {mode or 'not heard'}: it must be armed and at rest"
            )
        first = (time.time_ns() // TICK + FILL_AHEAD) * TICK
        plan_id, values = f"fill_{uuid.uuid4().hex[:8]}", [0.0] * self._segments
        values[segment] = side * pressure
        for index in range(round(FILLING * NANOSECONDS / TICK)):
            message = PressureSetpoint(plan_id=plan_id, index=index, differential_pressure=values)
            message.header.stamp = stamp_from_nanoseconds(first + index * TICK)
            self._setpoints.publish(message)
        which = f"segment {segment}, {'left' if side > 0 else 'right'}"
        return Answer(True, f"{which}: {pressure / 1000:.1f} kPa for {FILLING:.0f} s")

    def play_path(self, tip: np.ndarray[Any, Any], conditions: Conditions) -> Answer:
        """Let the planner play the nearest path that it can to points (P, 2) [m]."""
        points = [Point(x=float(x), y=float(y)) for x, y in tip]
        message = MotionCommand(path=points, nearest_path=True)
        return self._command(message, conditions, f"a path of {len(tip)} points")

    def _command(self, message: MotionCommand, conditions: Conditions, what: str) -> Answer:
        listeners = self._node.get_subscriptions_info_by_topic(self._motions.topic_name)
        if all(listener.node_name == RECORDER for listener in listeners):
            return Answer(False, "no planner listens: start it")
        load = conditions.load
        message.model, message.method = conditions.model, conditions.method
        message.feedback, message.mounting = conditions.feedback, load.mounting
        message.payload, message.payload_at = load.payload, load.payload_at
        self._motions.publish(message)
        return Answer(True, f"asked the planner for {what} with {conditions.model}")

    def learned_plans(self) -> list[str]:
        """Return the names of the learned plans in the folder that the planner says it has."""
        folder = self._situation.value_of("planner", "learned_plans")
        return learned_names(folder) if folder else []
