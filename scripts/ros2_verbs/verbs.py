"""What each verb of the table does: takes the command line's options, returns an exit code."""

from __future__ import annotations

import argparse
import math
import signal
import statistics
import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rcl_interfaces.msg import Parameter, ParameterDescriptor
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.action import ActionClient
from rclpy.duration import Duration
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.qos import qos_profile_sensor_data

from ros2_verbs.cli import CommandError
from ros2_verbs.messages import SHOWN, Filled, interface, to_yaml
from ros2_verbs.session import Session, is_hidden, qos_profile

# Topics.


def topic_list(options: argparse.Namespace) -> None:
    """List the topics."""
    with Session(options) as session:
        session.discover()
        found = session.topics()
    for name, types in found.items():
        if options.all or not is_hidden(name):
            print(f"{name} [{', '.join(types)}]" if options.show_types else name)


def topic_echo(options: argparse.Namespace) -> None:
    """Print the messages of a topic."""
    kind = interface(options.type_of_messages, "msg") if options.type_of_messages else None
    shown = None if options.full_length else SHOWN
    heard = []

    def show(message: Any) -> None:
        if options.once and heard:
            return
        heard.append(True)
        for name in options.field.split(".") if options.field else ():
            if not hasattr(message, name):
                raise CommandError(f"Invalid field '{options.field}'")
            message = getattr(message, name)
        whole = hasattr(message, "get_fields_and_field_types")
        print(to_yaml(message, shown, not options.no_arr) if whole else f"{message}\n", end="---\n")

    with Session(options) as session:
        topic, node = session.expand(options.topic_name), session.node
        session.discover(lambda: node.count_publishers(topic))
        kind = kind or session.topic_type(topic)
        if kind is None:
            raise CommandError(f"Could not determine the type for the passed topic '{topic}'")
        publishers = node.get_publishers_info_by_topic(topic)
        node.create_subscription(kind, topic, show, qos_profile(options, "sensor_data", publishers))
        session.wait(lambda: options.once and heard)


class RateMeter:
    """Statistics of the times between messages.

    Args:
        window: this many of the newest intervals count.
    """

    def __init__(self, window: int) -> None:
        self._intervals: deque[float] = deque(maxlen=window)
        self._newest: float | None = None
        self._reported = math.inf

    def add(self, now: float) -> str | None:
        """Count a message at a time [s]; return the statistics once for every second."""
        if self._newest is None:
            self._reported = now
        else:
            self._intervals.append(now - self._newest)
        self._newest = now
        if now < self._reported + 1.0:
            return None
        self._reported = now
        mean = statistics.fmean(self._intervals)
        return (
            f"average rate: {1.0 / mean if mean > 0 else 0.0:.3f}\n"
            f"\tmin: {min(self._intervals):.3f}s max: {max(self._intervals):.3f}s "
            f"std dev: {statistics.pstdev(self._intervals):.5f}s window: {len(self._intervals)}"
        )


def topic_hz(options: argparse.Namespace) -> None:
    """Print how often messages arrive, by the computer's steady clock."""
    meter = RateMeter(int(options.window))

    def count(_: Any) -> None:
        if text := meter.add(time.monotonic()):
            print(text)

    with Session(options) as session:
        topic = session.expand(options.topic_name)
        session.discover(lambda: topic in session.topics())
        if topic not in session.topics():
            print(f"WARNING: topic [{topic}] does not appear to be published yet")
            session.wait(lambda: topic in session.topics())
        kind = session.topic_type(topic)
        session.node.create_subscription(kind, topic, count, qos_profile_sensor_data, raw=True)
        session.wait(lambda: False)


def topic_pub(options: argparse.Namespace) -> None:
    """Publish a message once, some times, or until Ctrl-C."""
    filled = Filled(interface(options.message_type, "msg"), options.values)
    times = 1 if options.once else options.times or math.inf
    wanted = options.wait_matching_subscriptions
    if wanted is None:
        wanted = int(times < math.inf)
    with Session(options) as session:
        node = session.node
        profile = qos_profile(options, "default", [])
        publisher = node.create_publisher(type(filled.message), options.topic_name, profile)
        while not session.wait(lambda: publisher.get_subscription_count() >= wanted, 1.0):
            print(f"Waiting for at least {wanted} matching subscription(s)...")
        if options.wait_matching_subscriptions is None and times < math.inf:
            session.discover()  # other subscriptions match a little later
        print("publisher: beginning loop")
        due, count = time.monotonic(), 0
        while count < times:
            while (left := due - time.monotonic()) > 0.0:
                session.spin(min(left, 0.1))
            due, count = due + 1.0 / options.rate, count + 1
            filled.stamp(node.get_clock().now().to_msg())
            print(f"publishing #{count}: {filled.message!r}\n")
            publisher.publish(filled.message)
        # A busy machine may need long for a reliable message.
        session.spin(0.1)
        publisher.wait_for_all_acked(Duration(seconds=2))


# Services and actions.


def service_call(options: argparse.Namespace) -> None:
    """Call a service and print its response."""
    kind = interface(options.service_type, "srv")
    request = Filled(kind.Request, options.values).message
    with Session(options) as session:
        client = session.node.create_client(kind, options.service_name)
        if not session.wait(client.service_is_ready, 0.2):
            print("waiting for service to become available...")
            session.wait(client.service_is_ready)
        print(f"requester: making request: {request!r}\n")
        print(f"response:\n{session.answer(client.call_async(request))!r}\n")


def action_send_goal(options: argparse.Namespace) -> int:
    """Send a goal and wait for its result; Ctrl-C cancels it, a second one waits no longer."""
    kind = interface(options.action_type, "action")
    goal = Filled(kind.Goal, options.goal).message
    ends = {GoalStatus.STATUS_SUCCEEDED: "SUCCEEDED", GoalStatus.STATUS_CANCELED: "CANCELED"}

    def show(message: Any) -> None:
        print(f"Feedback:\n    {to_yaml(message.feedback)}")

    with Session(options) as session:
        client = ActionClient(session.node, kind, options.action_name)
        print("Waiting for an action server to become available...")
        session.wait(client.server_is_ready)
        # From before the goal is sent on: the server may move the limb before its answer is here.
        asked: list[int] = []
        signal.signal(signal.SIGINT, lambda number, _: asked.append(number))

        def result(future: Any, cancel: Callable[[], Any] | None = None) -> Any:
            cancelled = False
            while not future.done():
                session.spin()
                if asked and cancel is not None and not cancelled:
                    cancelled = True
                    print("Canceling goal...", file=sys.stderr)
                    cancel()
                if len(asked) > 1:
                    raise CommandError(
                        "the action server does not answer: the goal may still be carried out"
                    )
            if future.result() is None:
                raise CommandError(f"Exception while calling the action: {future.exception()!r}")
            return future.result()

        print(f"Sending goal:\n     {to_yaml(goal)}")
        handle = result(client.send_goal_async(goal, show if options.feedback else None))
        if not handle.accepted:
            print("Goal was rejected.")
            return 1
        print(f"Goal accepted with ID: {bytes(handle.goal_id.uuid).hex()}\n")
        answer = result(handle.get_result_async(), handle.cancel_goal_async)
        print(f"Result:\n    {to_yaml(answer.result)}")
        print(f"Goal finished with status: {ends.get(answer.status, 'ABORTED')}")
        client.destroy()
    return 0 if answer.status == GoalStatus.STATUS_SUCCEEDED else 1


# Parameters.

TYPES = (
    "not set", "boolean", "integer", "double", "string", "byte array",
    "boolean array", "integer array", "double array", "string array",
)  # fmt: skip
"""Names of the types of a parameter, in the order of rcl_interfaces/msg/ParameterType."""


def param_list(options: argparse.Namespace) -> None:
    """List the parameters of one node, or of all."""
    with Session(options) as session:
        if options.node_or_all:
            nodes = [session.find_node(options.node_or_all)]
        else:
            session.discover()
            services = session.services()
            nodes = [node for node in session.nodes() if f"{node}/list_parameters" in services]
        for node in nodes:
            request = ListParameters.Request()
            answer = session.call(ListParameters, f"{node}/list_parameters", request)
            if not options.node_or_all:
                print(f"{node}:")
            for name in sorted(answer.result.names):
                print(f"  {name}")


def _ask_node(options: argparse.Namespace, kind: Any, service: str, **request: Any) -> Any:
    """Return a node's answer to a request about its parameters."""
    with Session(options) as session:
        node = session.find_node(options.node_name)
        return session.call(kind, f"{node}/{service}", kind.Request(**request))


def param_get(options: argparse.Namespace) -> str | None:
    """Print the value of a parameter."""
    names = [options.parameter_name]
    values = _ask_node(options, GetParameters, "get_parameters", names=names).values
    if not values:
        return "Parameter not set"
    kind = TYPES[values[0].type]
    label = "values are:" if kind.endswith(" array") else "value is:"
    value = parameter_value_to_python(values[0])
    print(kind.removesuffix(" array").capitalize(), label, value)
    return None


def param_set(options: argparse.Namespace) -> None:
    """Set a parameter; its type is what the text is in YAML."""
    value = get_parameter_value(options.value)
    wanted = [Parameter(name=options.parameter_name, value=value)]
    answer = _ask_node(options, SetParameters, "set_parameters", parameters=wanted)
    result = answer.results[0]
    outcome = "Set parameter successful" if result.successful else "Setting parameter failed"
    reason = f": {result.reason}" if result.reason else ""
    # The real tool exits with 0 in both cases.
    print(outcome + reason, file=sys.stdout if result.successful else sys.stderr)


def param_describe(options: argparse.Namespace) -> None:
    """Print meaning, type and range of parameters."""
    names = options.parameter_names
    answer = _ask_node(options, DescribeParameters, "describe_parameters", names=names)
    for descriptor in answer.descriptors:
        _print_descriptor(descriptor)


def _print_descriptor(descriptor: ParameterDescriptor) -> None:
    print(f"Parameter name: {descriptor.name}")
    print(f"  Type: {TYPES[descriptor.type]}")
    if descriptor.description:
        print(f"  Description: {descriptor.description}")
    print("  Constraints:")
    if descriptor.read_only:
        print("    Read only: true")
    for limits in [*descriptor.floating_point_range, *descriptor.integer_range]:
        print(f"    Min value: {limits.from_value}\n    Max value: {limits.to_value}")
    if descriptor.additional_constraints:
        print(f"    Additional constraints: {descriptor.additional_constraints}")
