"""``ros2 topic pub``: publish messages."""

from __future__ import annotations

import argparse
import time
from typing import Any

import rclpy
from rclpy.duration import Duration

from ros2_verbs.cli import CommandError, add_verb
from ros2_verbs.filling import Filler, values_of
from ros2_verbs.messages import interface
from ros2_verbs.qos import add_qos_arguments, given_qos, preset
from ros2_verbs.session import Session


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError("value must be non-negative integer")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not value > 0.0:
        raise argparse.ArgumentTypeError("value must be positive")
    return value


def add_arguments(verbs: argparse._SubParsersAction) -> None:
    """Declare the verb and its arguments."""
    parser = add_verb(verbs, "pub", "Publish a message to a topic", _pub)
    parser.add_argument("topic_name", help="Name of the ROS topic to publish to (e.g. '/chatter')")
    parser.add_argument("message_type", help="Type of the ROS message (e.g. 'std_msgs/msg/String')")
    parser.add_argument(
        "values",
        nargs="?",
        default="{}",
        help="Values to fill the message with in YAML format (e.g. 'data: Hello World'); "
        "'header: auto' and 'stamp: now' become the time of sending",
    )
    parser.add_argument(
        "-r", "--rate", metavar="N", type=_positive, default=1.0, help="Rate in Hz (default: 1)"
    )
    parser.add_argument(
        "-p",
        "--print",
        metavar="N",
        type=_not_negative,
        default=1,
        help="Only print every N-th published message (default: 1)",
    )
    group = parser.add_mutually_exclusive_group()
    group.add_argument("-1", "--once", action="store_true", help="Publish one message and exit")
    group.add_argument(
        "-t",
        "--times",
        metavar="TIMES",
        type=_not_negative,
        default=0,
        help="Publish this number of times and then exit",
    )
    parser.add_argument(
        "-w",
        "--wait-matching-subscriptions",
        metavar="N",
        type=_not_negative,
        help="Wait until finding the specified number of matching subscriptions. "
        "Defaults to 1 when using -1/--once/--times, otherwise to 0",
    )
    parser.add_argument(
        "--max-wait-time-secs",
        metavar="N",
        type=_positive,
        help="Wait at most N seconds for the subscriptions (default: for ever)",
    )
    parser.add_argument(
        "--keep-alive",
        metavar="N",
        type=_positive,
        default=0.1,
        help="Keep the node alive for N seconds after the last message (default: 0.1)",
    )
    parser.add_argument("-n", "--node-name", default="", help="Name of the publishing node")
    parser.add_argument("-s", "--use-sim-time", action="store_true", help="Use simulation time")
    add_qos_arguments(parser, "publish", "default")


def _wait(publisher: Any, wanted: int, at_most: float | None) -> None:
    """Wait for subscriptions; says so once a second."""
    started = time.monotonic()
    said = 0
    while publisher.get_subscription_count() < wanted:
        waited = time.monotonic() - started
        if waited >= said:
            print(f"Waiting for at least {wanted} matching subscription(s)...")
            said += 1
        if at_most is not None and waited >= at_most:
            raise CommandError(
                f"Timed out waiting for subscribers: Expected {wanted} subscribers but only got "
                f"{publisher.get_subscription_count()} subscribers"
            )
        time.sleep(0.1)


def _pub(options: argparse.Namespace) -> None:
    kind = interface(options.message_type, "msg")
    values = values_of(options.values)
    if not isinstance(values, dict):
        raise CommandError("The passed value needs to be a dictionary in YAML format")
    times = 1 if options.once else options.times
    wanted = options.wait_matching_subscriptions
    if wanted is None:
        wanted = int(times > 0)
        if options.max_wait_time_secs is not None and not wanted:
            raise CommandError(
                "--max-wait-time-secs option is only effective with "
                "--wait-matching-subscriptions, --once or --times"
            )
    profile = given_qos(options) or preset(options.default_profile)
    with Session(options, name=options.node_name) as session:
        node = session.node
        publisher = node.create_publisher(kind, options.topic_name, profile)
        _wait(publisher, wanted, options.max_wait_time_secs)
        filler = Filler(kind(), values)
        print("publisher: beginning loop")
        count = 0

        def publish() -> None:
            nonlocal count
            if times and count >= times:
                return
            count += 1
            filler.stamp(node.get_clock().now().to_msg())
            if options.print and count % options.print == 0:
                print(f"publishing #{count}: {filler.message!r}\n")
            publisher.publish(filler.message)

        publish()
        timer = node.create_timer(1.0 / options.rate, publish)
        while times == 0 or count < times:
            rclpy.spin_once(node, timeout_sec=0.2)
        node.destroy_timer(timer)
        time.sleep(options.keep_alive)
        # On a busy machine a reliable message may need longer than that.
        publisher.wait_for_all_acked(Duration(seconds=2))
