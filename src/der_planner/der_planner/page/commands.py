"""What the page's buttons do to the graph: the services and topics that a terminal would use."""

from __future__ import annotations

import asyncio
import json
import time
import uuid
from dataclasses import dataclass
from typing import Any

from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import Trigger

from der_msgs.msg import MotionCommand, PressureSetpoint
from der_planner.page.alarm import SUPPLY
from der_planner.page.situation import Situation
from der_planner.planning.plan_file import learned_names
from limb_interfaces import qos, topics
from limb_interfaces.stamps import NANOSECONDS, stamp_from_nanoseconds

SERVICES = {
    "vent": "pressure_driver/vent",
    "arm": "pressure_driver/arm",
    "start": "planner/start",
    "stop": "planner/stop",
    "record_start": "recorder/start",
    "record_stop": "recorder/stop",
}
"""Services by what the page calls them, each with the node that serves it."""
PATIENCE = 3.0
"""A service's answer is waited for during this time [s]."""
LOOK = 0.05
"""The planner's diagnostics are looked at again after this time [s]."""
DECISION = 0.3
"""A command that was taken is refused within this time [s], if the driver takes nothing."""
FILLING = 3.0
"""One chamber alone is filled for this time [s]; then the driver lets it down by itself."""
TICK = NANOSECONDS // 20
"""Time [ns] between two setpoints."""
TICKS_AHEAD = 4
"""The first setpoint of a filling takes effect this many ticks after now."""
_AWAY = "does not run or cannot be reached"


@dataclass(frozen=True)
class Answer:
    """What came of a request, in the words of the node that was asked."""

    success: bool
    message: str


class Commands:
    """The graph as the page commands it; what waits for an answer lets the page go on.

    Args:
        node: of the page.
        situation: what the nodes have said of themselves.
    """

    def __init__(self, node: Node, situation: Situation) -> None:
        self._node = node
        self._situation = situation
        self._service_clients = {
            service: node.create_client(Trigger, path) for service, path in SERVICES.items()
        }
        self._recorder_parameters = node.create_client(SetParameters, "recorder/set_parameters")
        self._setpoints = node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
        )
        self._motions = node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)

    async def call(self, service: str) -> Answer:
        """Call one of `SERVICES`; say so if no answer comes."""
        node = SERVICES[service].partition("/")[0]
        response, trouble = await _ask(node, self._service_clients[service], Trigger.Request())
        if response is not None:
            return Answer(bool(response.success), response.message)
        if service == "vent":
            doubt = "" if trouble.endswith(_AWAY) else " as far as the page knows"
            trouble += f": NOT VENTED{doubt}; {SUPPLY}"
        return Answer(False, trouble)

    async def record(self, note: str) -> Answer:
        """Start the recorder with a note in the bag's metadata."""
        metadata = Parameter("metadata", value=json.dumps({"note": note})).to_parameter_msg()
        request = SetParameters.Request(parameters=[metadata])
        response, trouble = await _ask("recorder", self._recorder_parameters, request)
        if response is None:
            return Answer(False, trouble)
        if not response.results[0].successful:
            return Answer(False, response.results[0].reason)
        return await self.call("record_start")

    async def play(self, command: MotionCommand) -> Answer:
        """Publish a motion command under a new plan id, and return what the planner says of it."""
        listeners = self._node.get_subscriptions_info_by_topic(self._motions.topic_name)
        # The recorder listens to commands without following them.
        if all(listener.node_name == "recorder" for listener in listeners):
            return Answer(False, "no planner listens: start it")
        command.plan_id = f"page-{uuid.uuid4().hex[:8]}"
        self._motions.publish(command)
        what = command.motion or f"a path of {len(command.path)} points"
        end, taken = time.monotonic() + PATIENCE, False
        while time.monotonic() < end:
            await asyncio.sleep(LOOK)
            refused = self._situation.value_of("planner", "last_refusal")
            plan_id, _, refusal = refused.partition(": ")
            if plan_id == f"plan {command.plan_id}":
                return Answer(False, f"refused: {refusal}")
            if not taken and self._situation.value_of("planner", "plan_id") == command.plan_id:
                # The driver's next state decides whether it is refused.
                taken, end = True, time.monotonic() + DECISION
        if taken:
            return Answer(True, f"the planner plans {what} with {command.model}")
        return Answer(False, f"the planner has not answered within {PATIENCE:.0f} s")

    def fill(self, segment: int, side: int, pressure: float, segments: int) -> Answer:
        """Fill one chamber alone for `FILLING`, if the driver is armed and nothing is played.

        Args:
            segment: its number, 0 at the clamp.
            side: 1 for the left chamber, which bends counter-clockwise, -1 for the right one.
            pressure: differential pressure [Pa], above zero.
            segments: of the limb.
        """
        mode = self._situation.driver_mode
        if mode != "armed":
            text = f"the driver is {mode or 'not heard'}: it must be armed and at rest"
            return Answer(False, text)
        first = (time.time_ns() // TICK + TICKS_AHEAD) * TICK
        plan_id, values = f"fill_{uuid.uuid4().hex[:8]}", [0.0] * segments
        values[segment] = side * pressure
        for index in range(round(FILLING * NANOSECONDS / TICK)):
            message = PressureSetpoint(plan_id=plan_id, index=index, differential_pressure=values)
            message.header.stamp = stamp_from_nanoseconds(first + index * TICK)
            self._setpoints.publish(message)
        which = f"segment {segment}, {'left' if side > 0 else 'right'}"
        return Answer(True, f"{which}: {pressure / 1000:.1f} kPa for {FILLING:.0f} s")

    def learned_plans(self) -> list[str]:
        """Return the names of the learned plans in the folder that the planner says it has."""
        folder = self._situation.value_of("planner", "learned_plans")
        return learned_names(folder) if folder else []


async def _ask(node: str, client: Any, request: Any) -> tuple[Any, str]:
    """Return the response of a node's service, or None and why there is none."""
    loop, came = asyncio.get_running_loop(), asyncio.Event()
    try:
        if not client.service_is_ready():
            return None, f"{node} {_AWAY}"
        pending = client.call_async(request)
        # It comes in the executor's thread.
        pending.add_done_callback(lambda _: loop.call_soon_threadsafe(came.set))
        await asyncio.wait_for(came.wait(), PATIENCE)
        return pending.result(), ""
    except asyncio.TimeoutError:
        return None, f"no answer from {node} within {PATIENCE:.0f} s"
    except Exception as error:  # whatever failed, the operator must read it
        return None, f"{node}: {error or type(error).__name__}"
