"""Publish a recorded bag again, with /clock, so that nodes can be run on what was recorded.

python3 scripts/replay_bag.py BAG --topics /limb/camera/image_raw /limb/camera/camera_info
python3 scripts/replay_bag.py BAG --rate 0 --step-by /limb/camera/image_raw=/limb/state

Nodes that should live in recorded time need the parameter use_sim_time:=true. With --step-by each
message of the first topic is followed by nothing until the message of the same stamp is on the
second, so no image is lost however slow the receiver is, and the answers are the same each time.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock

from der_planner.bags.reader import BagError, BagReader, RawMessage, RecordedTopic
from der_planner.bags.record import NANOSECONDS
from der_planner.bags.topics import DefinitionError, message_class
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import OptionError, Progress, command, interrupt_once
from der_planner.experiment.processes import GraphError
from limb_interfaces import qos
from limb_interfaces import topics as names

CLOCK_PERIOD = NANOSECONDS // 100
"""Recorded time between two messages on ``/clock`` [ns] while nothing else is due."""
COMMANDING = (
    names.COMMAND,
    names.PATH,
    names.PRESSURE_SETPOINT,
    names.CMD_U_T,
    names.OPERATOR_LEASE,
    names.TWIN_PUSH,
)
"""Topics by which a limb, or its twin, moves."""
DEPTH = 100
"""So many messages of a topic may wait for their receivers, and answers for this program."""
ATTEMPTS = 3
PATIENCE = 3.0
"""Longest wait for one answer [s]; then the message is sent again."""
SETTLE = 0.3
"""Time [s] for a receiver's callback after the first message of a topic that nothing answers."""


# What is played ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Selection:
    """What of a bag is played.

    Attributes:
        start: seconds after the bag's first message at which to begin.
        stop: seconds after it at which to end; None = the bag's end.
        topics: only these recorded names; if empty, all that command nothing.
        remap: recorded name to the name to publish on.
    """

    start: float = 0.0
    stop: float | None = None
    topics: Sequence[str] = ()
    remap: Mapping[str, str] = field(default_factory=dict)

    def window(self, bag: BagReader) -> tuple[int, int]:
        """Return the first log time that is played, and the one before which to stop [ns].

        Raises:
            BagError: nothing lies between them.
        """
        first, last = bag.start + round(self.start * NANOSECONDS), bag.end + 1
        if self.stop is not None:
            last = min(last, bag.start + round(self.stop * NANOSECONDS))
        if last <= first:
            raise BagError(
                f"nothing lies between {self.start} s and {(last - bag.start) / NANOSECONDS:g} s "
                "from the bag's first message"
            )
        return first, last


def commands(topic: str) -> bool:
    """Tell whether a limb may move by what is published on a topic."""
    return topic.endswith(tuple(f"/{name}" for name in COMMANDING))


def choose_topics(bag: BagReader, wanted: Selection) -> dict[str, RecordedTopic]:
    """Return the topics to play by the name to publish on.

    Raises:
        BagError: a name that is asked for or remapped is not in the bag, two share a name, or
            a type is of another version than here.
        DefinitionError: a type is not installed here.
    """
    known = bag.topics
    for name in (*wanted.topics, *wanted.remap):
        if name not in known:
            raise BagError(f"{bag.path} has no topic {name}, only {', '.join(sorted(known))}")
    chosen: dict[str, RecordedTopic] = {}
    for name in wanted.topics or [each for each in known if not commands(each)]:
        target = wanted.remap.get(name, name)
        if target in chosen:
            raise BagError(f"{chosen[target].name} and {name} would both be played on {target}")
        chosen[target] = known[name]
    others = sorted({t.type_name for t in chosen.values() if not bag.fits_installed(t.type_name)})
    if others:
        raise BagError(
            f"{bag.path} has another version of {', '.join(others)} than is installed here, whose "
            "listeners would read other numbers: name the topics to play with --topics"
        )
    return chosen


def replay(bag: BagReader, wanted: Selection) -> Iterator[tuple[int, str, RawMessage | None]]:
    """Yield what is published, in recorded order: recorded time [ns], topic, message.

    At the beginning, and every `CLOCK_PERIOD` between messages, there is the time alone.

    Args:
        bag: open.
        wanted: what to play.

    Raises:
        BagError: as `choose_topics` and `Selection.window`.
    """
    names = {topic.name: target for target, topic in choose_topics(bag, wanted).items()}
    shown, last = wanted.window(bag)
    yield shown, "", None
    for message in bag.raw(list(names), shown, last):
        while shown + CLOCK_PERIOD < message.log_time:
            shown += CLOCK_PERIOD
            yield shown, "", None
        shown = message.log_time
        yield shown, names[message.topic], message


# Onto the graph ----------------------------------------------------------------------------------


def _stamp(data: bytes) -> bytes:
    """Return the stamp of a serialized message that begins with a std_msgs/Header, as it is."""
    return bytes(data[4:12])


class GraphOutput:
    """Publishes on the graph; waits for answers where asked to.

    Args:
        client: whose node publishes.
        topics: recorded topics by the name to publish on.
        step_by: name to publish on that waits for answers, or empty.
        answer: topic of the answers.

    Raises:
        DefinitionError: a message cannot be published here.
        GraphError: nothing answers.
    """

    def __init__(
        self,
        client: GraphClient,
        topics: dict[str, RecordedTopic],
        step_by: str = "",
        answer: str = "",
    ) -> None:
        self.unanswered = 0
        self._client, self._step_by = client, step_by
        self._begun: set[str] = set()
        self._answers: set[bytes] = set()
        node = client.node
        self._publishers: dict[str, Publisher] = {
            name: node.create_publisher(
                message_class(topic.type_name),
                name,
                qos.profile(DEPTH, topic.reliable, topic.latched),
            )
            for name, topic in topics.items()
        }
        self._clock = node.create_publisher(Clock, "/clock", 10)
        if step_by:
            kind = client.wait_for(
                lambda: dict(node.get_topic_names_and_types()).get(answer),
                20.0,
                f"{answer}: start the node that answers first",
            )
            node.create_subscription(
                message_class(kind[0]),
                answer,
                lambda data: self._answers.add(_stamp(data)),
                QoSProfile(depth=DEPTH),
                raw=True,
            )

    def wait_for_receivers(self, seconds: float) -> None:
        """Wait until every topic has a subscriber, at most so long."""
        publishers = self._publishers.values()
        with contextlib.suppress(GraphError):
            self._client.wait_for(
                lambda: all(each.get_subscription_count() for each in publishers),
                seconds,
                "receivers",
            )

    def publish(self, topic: str, message: RawMessage) -> None:
        """Publish one message, and wait for its answer where the topic is stepped by."""
        if topic != self._step_by:
            self._publishers[topic].publish(message.data)
            if self._step_by and topic not in self._begun:
                # E.g. the camera's calibration: it must be taken before the first image comes.
                self._begun.add(topic)
                self._publishers[topic].wait_for_all_acked(Duration(seconds=1))
                time.sleep(SETTLE)
            return
        self._answers.clear()
        for _ in range(ATTEMPTS):
            self._publishers[topic].publish(message.data)
            with contextlib.suppress(GraphError):
                self._client.wait_for(
                    lambda: _stamp(message.data) in self._answers, PATIENCE, "an answer"
                )
                return
        self.unanswered += 1

    def show_time(self, now: int) -> None:
        """Publish recorded time."""
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(now, NANOSECONDS)
        self._clock.publish(message)


def _options(parser: argparse.ArgumentParser) -> argparse.Namespace:
    parser.add_argument("bag", type=Path, metavar="BAG", help="folder, .mcap or .db3 file")
    parser.add_argument("--rate", type=float, default=1.0, help="0: as fast as possible")
    parser.add_argument("--from", dest="start", type=float, default=0.0, metavar="S")
    parser.add_argument("--to", dest="stop", type=float, default=None, metavar="S")
    parser.add_argument(
        "--topics",
        nargs="+",
        default=[],
        metavar="TOPIC",
        help="only these (default: all that command nothing)",
    )
    parser.add_argument("--remap", nargs="+", default=[], metavar="OLD=NEW")
    parser.add_argument("--step-by", default="", metavar="TOPIC=ANSWER", help="wait for answers")
    parser.add_argument(
        "--wait", type=float, default=3.0, metavar="S", help="for subscribers before the start"
    )
    return parser.parse_args()


def _pairs(values: list[str], what: str) -> dict[str, str]:
    for value in values:
        if value.count("=") != 1:
            raise OptionError(f"{what} '{value}' is not of the form A=B")
    return dict(value.split("=") for value in values)


@command(BagError, DefinitionError, GraphError)
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line."""
    given = _options(parser)
    interrupt_once()
    if given.rate < 0:
        raise OptionError(f"--rate is {given.rate}: choose 0 or more")
    wanted = Selection(given.start, given.stop, given.topics, _pairs(given.remap, "--remap"))
    stepping = _pairs([given.step_by] if given.step_by else [], "--step-by")
    step_by, answer = next(iter(stepping.items()), ("", ""))
    progress, count = Progress(), 0
    with BagReader(given.bag) as bag, GraphClient("replay_bag") as client:
        topics = choose_topics(bag, wanted)
        first, last = wanted.window(bag)
        output = GraphOutput(client, topics, step_by, answer)
        output.wait_for_receivers(given.wait)
        begin = time.monotonic()
        for when, topic, message in replay(bag, wanted):
            since = (when - first) / NANOSECONDS
            if given.rate:
                time.sleep(max(0.0, begin + since / given.rate - time.monotonic()))
            output.show_time(when)
            if message is not None:
                output.publish(topic, message)
                count += 1
            progress.bar(since, (last - first) / NANOSECONDS, "played")
        left = [] if wanted.topics else sorted(filter(commands, bag.topics))
        time.sleep(0.2)  # the last messages leave the process
    print(f"published {count} messages of {len(topics)} topics")
    if left:
        print(f"left out, since a limb would move by them: {', '.join(left)} (--topics plays them)")
    if count == 0:
        print(
            "error: no message of the chosen topics lies between --from and --to", file=sys.stderr
        )
    if output.unanswered:
        print(f"error: {output.unanswered} messages got no answer", file=sys.stderr)
    return 1 if count == 0 or output.unanswered else 0
