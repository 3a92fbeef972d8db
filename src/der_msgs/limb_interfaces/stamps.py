"""Between ROS stamps and numbers; what is missing between the stamps of a stream."""

from __future__ import annotations

from collections import deque

from builtin_interfaces.msg import Time

NANOSECONDS = 1_000_000_000


def nanoseconds(stamp: Time) -> int:
    """Return a stamp as integer nanoseconds since the epoch of its clock."""
    return stamp.sec * NANOSECONDS + stamp.nanosec


def seconds(stamp: Time) -> float:
    """Return a stamp in s; a double resolves 0.2 µs at today's Unix time."""
    return stamp.sec + stamp.nanosec * 1e-9


def stamp_from_nanoseconds(value: int) -> Time:
    """Return the stamp of integer nanoseconds."""
    return Time(sec=value // NANOSECONDS, nanosec=value % NANOSECONDS)


class StampGaps:
    """Counts what is missing between the stamps of a stream of nearly constant rate.

    The period is the interval below which a tenth of the last `window` ones lie: so even if most
    messages are lost, the few neighbours that both arrive tell it. A gap of k periods is k − 1
    missed messages; one longer than ``pause`` is a source that paused, and counts none.

    Args:
        window: intervals that tell the period.
        pause: [s].
    """

    def __init__(self, window: int = 100, pause: float = 5.0) -> None:
        self._intervals: deque[int] = deque(maxlen=window)
        self._pause = round(pause * NANOSECONDS)
        self._newest = 0
        self.missed = 0
        """Messages that did not arrive between those that did."""

    def take(self, stamp: int) -> None:
        """Take the stamp [ns] of a message; zero means nothing, one that goes back begins anew."""
        if stamp <= 0:
            return
        before, self._newest = self._newest, stamp
        interval = stamp - before
        if before == 0 or not 0 < interval <= self._pause:
            return
        self._intervals.append(interval)
        if len(self._intervals) >= 2:
            period = sorted(self._intervals)[len(self._intervals) // 10]
            self.missed += round(interval / period) - 1
