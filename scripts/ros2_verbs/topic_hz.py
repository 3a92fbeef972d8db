"""``ros2 topic hz``: print how often messages arrive."""

from __future__ import annotations

import argparse
import math
import time
from collections import deque
from typing import Any

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.qos import qos_profile_sensor_data

from ros2_verbs.cli import add_verb
from ros2_verbs.session import Session, add_session_arguments
from ros2_verbs.topic_echo import expression, topic_type

DEFAULT_WINDOW_SIZE = 10000


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError("value must be a positive integer")
    return int(text)


def add_arguments(verbs: argparse._SubParsersAction) -> None:
    """Declare the verb and its arguments."""
    parser = add_verb(verbs, "hz", "Print the average receiving rate to screen", _hz)
    add_session_arguments(parser)
    parser.add_argument("topic_name", help="Name of the ROS topic to listen to (e.g. '/chatter')")
    parser.add_argument(
        "--window",
        "-w",
        dest="window_size",
        metavar="WINDOW",
        type=_positive,
        default=DEFAULT_WINDOW_SIZE,
        help=f"window size, in # of messages, for the rate (default: {DEFAULT_WINDOW_SIZE})",
    )
    parser.add_argument(
        "--filter", metavar="EXPR", help="only measure messages matching the Python expression of m"
    )
    parser.add_argument(
        "--wall-time", action="store_true", help="calculates rate using wall time, not ROS time"
    )


class RateMeter:
    """Statistics of the times between messages.

    Args:
        window: this many of the newest intervals count.
    """

    def __init__(self, window: int) -> None:
        self._intervals: deque[float] = deque(maxlen=window)
        self._newest: float | None = None
        self._reported: float | None = None

    def add(self, now: float) -> None:
        """Count a message that arrived at the time ``now`` [s]; time that runs back restarts."""
        if self._newest is not None and now < self._newest:
            self._intervals.clear()
            self._newest = self._reported = None
        if self._newest is not None:
            self._intervals.append(now - self._newest)
        self._newest = now

    def report(self) -> str | None:
        """Return the statistics, at most once for every second of messages; else None."""
        if not self._intervals or self._newest is None:
            return None
        if self._reported is None:
            self._reported = self._newest
            return None
        if self._newest < self._reported + 1.0:
            return None
        self._reported = self._newest
        count = len(self._intervals)
        mean = math.fsum(self._intervals) / count
        deviation = math.sqrt(math.fsum((item - mean) ** 2 for item in self._intervals) / count)
        return (
            f"average rate: {1.0 / mean if mean > 0 else 0.0:.3f}\n"
            f"\tmin: {min(self._intervals):.3f}s max: {max(self._intervals):.3f}s "
            f"std dev: {deviation:.5f}s window: {count}"
        )


def _hz(options: argparse.Namespace) -> None:
    matches = expression(options.filter)
    meter = RateMeter(options.window_size)
    with Session(options) as session:
        topic = session.expand(options.topic_name)
        session.discover(lambda: topic in session.topics())
        kind = topic_type(session, topic)
        if kind is None:
            print(f"WARNING: topic [{options.topic_name}] does not appear to be published yet")
        while kind is None:
            time.sleep(0.1)
            kind = topic_type(session, topic)
        clock = session.node.get_clock()
        if options.wall_time:
            clock = Clock(clock_type=ClockType.SYSTEM_TIME)

        def count(message: Any) -> None:
            if matches(message):
                meter.add(clock.now().nanoseconds * 1e-9)

        # Only a filter needs the contents.
        session.node.create_subscription(
            kind, topic, count, qos_profile_sensor_data, raw=options.filter is None
        )
        while True:
            rclpy.spin_once(session.node, timeout_sec=0.2)
            if text := meter.report():
                print(text)
