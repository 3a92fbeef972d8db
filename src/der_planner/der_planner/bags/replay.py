"""Play a bag again: the same bytes in the same order, at the recorded pace or any other.

What publishes and what sleeps is injected, so that this module needs no ROS. ``/clock`` runs with
the messages: before each one it shows the time at which that message was recorded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from der_planner.bags.reader import BagError, BagReader, RawMessage, RecordedTopic
from der_planner.bags.record import NANOSECONDS

CLOCK_PERIOD = NANOSECONDS // 100
"""Recorded time between two messages on ``/clock`` [ns] while nothing else is due."""


@dataclass(frozen=True)
class ReplaySettings:
    """What of a bag is played, and how.

    Attributes:
        rate: recorded seconds per second; 0 plays as fast as the receivers take it.
        start: seconds after the bag's first message at which to begin.
        stop: seconds after it at which to end; None = the bag's end.
        topics: only these recorded names; all if empty.
        exclude: recorded names to leave out.
        remap: recorded name to the name to publish on.
    """

    rate: float = 1.0
    start: float = 0.0
    stop: float | None = None
    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
    remap: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.rate < 0:
            raise BagError(f"the rate must be 0 or more, got {self.rate}")
        if self.stop is not None and self.stop <= self.start:
            raise BagError(f"nothing lies between {self.start} s and {self.stop} s")


class Output(Protocol):
    """Where the messages go."""

    def publish(self, topic: str, message: RawMessage) -> None:
        """Publish serialized bytes on a topic (already remapped)."""

    def show_time(self, now: int) -> None:
        """Publish recorded time [ns] on ``/clock``."""


def choose_topics(bag: BagReader, settings: ReplaySettings) -> dict[str, RecordedTopic]:
    """Return the topics to play by the name to publish on.

    Raises:
        BagError: a name that is asked for or remapped is not in the bag, or two share a name.
    """
    known = bag.topics
    for name in (*settings.topics, *settings.exclude, *settings.remap):
        if name not in known:
            raise BagError(f"{bag.path} has no topic {name}, only {', '.join(sorted(known))}")
    wanted = settings.topics or list(known)
    chosen: dict[str, RecordedTopic] = {}
    for name in wanted:
        if name in settings.exclude:
            continue
        target = settings.remap.get(name, name)
        if target in chosen:
            raise BagError(f"{chosen[target].name} and {name} would both be played on {target}")
        chosen[target] = known[name]
    return chosen


def replay(
    bag: BagReader,
    settings: ReplaySettings,
    output: Output,
    *,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    progress: Callable[[float, float], None] | None = None,
) -> int:
    """Play the bag and return the number of messages published.

    Args:
        bag: open.
        settings: what to play.
        output: takes the messages.
        clock: monotonic seconds.
        sleep: waits some seconds.
        progress: called with played and whole length [s].

    Raises:
        BagError: as `choose_topics`.
    """
    names = {topic.name: target for target, topic in choose_topics(bag, settings).items()}
    first = bag.start + round(settings.start * NANOSECONDS)
    last = bag.end + 1
    if settings.stop is not None:
        last = min(last, bag.start + round(settings.stop * NANOSECONDS))
    begin, shown, count = clock(), first, 0
    output.show_time(first)

    def show(when: int) -> None:
        nonlocal shown
        if settings.rate > 0:
            due = begin + (when - first) / NANOSECONDS / settings.rate
            sleep(max(0.0, due - clock()))
        shown = when
        output.show_time(when)

    for message in bag.raw(list(names), first, last):
        while shown + CLOCK_PERIOD < message.log_time:
            show(shown + CLOCK_PERIOD)
        if message.log_time > shown:
            show(message.log_time)
        output.publish(names[message.topic], message)
        count += 1
        if progress is not None:
            progress((message.log_time - first) / NANOSECONDS, (last - first) / NANOSECONDS)
    return count
