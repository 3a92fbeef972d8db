"""What of a bag is played again, on which topics, and at which recorded instants."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from der_planner.bags.reader import BagError, BagReader, RawMessage, RecordedTopic
from der_planner.bags.record import NANOSECONDS

CLOCK_PERIOD = NANOSECONDS // 100
"""Recorded time between two messages on ``/clock`` [ns] while nothing else is due."""


@dataclass(frozen=True)
class Selection:
    """What of a bag is played.

    Attributes:
        start: seconds after the bag's first message at which to begin.
        stop: seconds after it at which to end; None = the bag's end.
        topics: only these recorded names; all if empty.
        exclude: recorded names to leave out.
        remap: recorded name to the name to publish on.
    """

    start: float = 0.0
    stop: float | None = None
    topics: Sequence[str] = ()
    exclude: Sequence[str] = ()
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


def choose_topics(bag: BagReader, wanted: Selection) -> dict[str, RecordedTopic]:
    """Return the topics to play by the name to publish on.

    Raises:
        BagError: a name that is asked for or remapped is not in the bag, or two share a name.
    """
    known = bag.topics
    for name in (*wanted.topics, *wanted.exclude, *wanted.remap):
        if name not in known:
            raise BagError(f"{bag.path} has no topic {name}, only {', '.join(sorted(known))}")
    chosen: dict[str, RecordedTopic] = {}
    for name in wanted.topics or known:
        if name in wanted.exclude:
            continue
        target = wanted.remap.get(name, name)
        if target in chosen:
            raise BagError(f"{chosen[target].name} and {name} would both be played on {target}")
        chosen[target] = known[name]
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
