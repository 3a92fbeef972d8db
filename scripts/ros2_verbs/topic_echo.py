"""``ros2 topic echo``: print the messages of a topic."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from types import CodeType
from typing import Any

import rclpy
from rclpy.event_handler import SubscriptionEventCallbacks

from ros2_verbs.cli import CommandError, add_verb
from ros2_verbs.messages import interface, to_csv, to_yaml
from ros2_verbs.qos import add_qos_arguments, given_qos, matching_qos, preset
from ros2_verbs.session import Session, add_session_arguments

DEFAULT_TRUNCATE_LENGTH = 128


def _length(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError("value must be non-negative integer")
    return int(text)


def add_arguments(verbs: argparse._SubParsersAction) -> None:
    """Declare the verb and its arguments."""
    parser = add_verb(verbs, "echo", "Output messages from a topic", _echo)
    add_session_arguments(parser)
    parser.add_argument("topic_name", help="Name of the ROS topic to listen to (e.g. '/chatter')")
    parser.add_argument(
        "message_type", nargs="?", help="Type of the ROS message (e.g. 'std_msgs/msg/String')"
    )
    add_qos_arguments(parser, "subscribe", "sensor_data")
    parser.add_argument(
        "--csv", action="store_true", help="Output all recursive fields separated by commas"
    )
    parser.add_argument(
        "--field",
        help="Echo a selected field of a message. Use '.' to select sub-fields "
        "(e.g. --field pose.pose.position)",
    )
    parser.add_argument(
        "--full-length",
        "-f",
        action="store_true",
        help="Output all elements of arrays, bytes, and strings longer than --truncate-length",
    )
    parser.add_argument(
        "--truncate-length",
        "-l",
        type=_length,
        default=DEFAULT_TRUNCATE_LENGTH,
        help=f"The length to truncate to (default: {DEFAULT_TRUNCATE_LENGTH})",
    )
    parser.add_argument("--no-arr", action="store_true", help="Don't print array fields")
    parser.add_argument("--no-str", action="store_true", help="Don't print string fields")
    parser.add_argument(
        "--flow-style", action="store_true", help="Print a message on one line (not with --csv)"
    )
    parser.add_argument(
        "--no-lost-messages", action="store_true", help="Don't report when a message is lost"
    )
    parser.add_argument("--raw", action="store_true", help="Echo the raw binary representation")
    parser.add_argument(
        "--filter", metavar="EXPR", help="Python expression of `m` which messages must fulfil"
    )
    parser.add_argument(
        "--once", action="store_true", help="Print the first message received and then exit"
    )


def topic_type(session: Session, topic: str) -> Any:
    """Return the class of a topic's messages, None if the topic is not there.

    Raises:
        CommandError: the topic has several types, or one that is not installed.
    """
    types = session.topics().get(session.expand(topic), [])
    if len(types) > 1:
        raise CommandError(
            f"Cannot echo topic '{topic}', as it contains more than one type: [{', '.join(types)}]"
        )
    return interface(types[0], "msg") if types else None


def expression(text: str | None) -> Callable[[Any], Any]:
    """Return the filter of the command line as a function of the message, true if there is none.

    Raises:
        CommandError: the text is no Python expression.
    """
    if not text:
        return lambda _: True
    try:
        code: CodeType = compile(text, "--filter", "eval")
    except SyntaxError as error:
        raise CommandError(f"Invalid filter expression '{text}': {error}") from error
    return lambda message: eval(code, {}, {"m": message})


class _Printer:
    """Prints messages as the options want it; ``done`` after the first one with ``--once``."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.done = False
        self._options = options
        self._matches = expression(options.filter)
        self._fields = [] if options.field is None else list(filter(None, options.field.split(".")))
        if options.field is not None and not self._fields:
            raise CommandError(f"Invalid field value '{options.field}'")

    def __call__(self, message: Any) -> None:
        options = self._options
        if self.done:
            return
        for field in self._fields:
            try:
                message = getattr(message, field)
            except AttributeError as error:
                raise CommandError(f"Invalid field '{options.field}': {error}") from error
        if not self._matches(message):
            return
        self.done = options.once
        truncate = None if options.full_length else options.truncate_length
        if not hasattr(message, "get_fields_and_field_types"):
            print(message, end="\n" if options.csv else "\n---\n")
        elif options.csv:
            print(to_csv(message, truncate, options.no_arr, options.no_str))
        else:
            text = to_yaml(message, truncate, options.no_arr, options.no_str, options.flow_style)
            print(text, end="---\n")


def _report_loss(status: Any) -> None:
    print(
        f"A message was lost!!!\n\ttotal count change:{status.total_count_change}"
        f"\n\ttotal count: {status.total_count}",
        end="---\n",
    )


def _echo(options: argparse.Namespace) -> None:
    printer = _Printer(options)
    kind = interface(options.message_type, "msg") if options.message_type else None
    with Session(options) as session:
        topic = session.expand(options.topic_name)
        if options.spin_time is not None or kind is None or given_qos(options) is None:
            session.discover(lambda: session.node.count_publishers(topic))
        if kind is None:
            kind = topic_type(session, topic)
        if kind is None:
            print(f"WARNING: topic [{options.topic_name}] does not appear to be published yet")
            raise CommandError("Could not determine the type for the passed topic")
        profile = given_qos(options) or matching_qos(
            session.node.get_publishers_info_by_topic(topic), preset(options.default_profile)
        )
        events = None
        if not options.no_lost_messages:
            events = SubscriptionEventCallbacks(message_lost=_report_loss)
        session.node.create_subscription(
            kind, topic, printer, profile, event_callbacks=events, raw=options.raw
        )
        while not printer.done:
            rclpy.spin_once(session.node, timeout_sec=0.2)
