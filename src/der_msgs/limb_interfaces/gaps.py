"""How many messages of a regular stream did not arrive, told from the stamps of those that did."""

from __future__ import annotations

from collections import deque

NANOSECONDS = 1_000_000_000


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
        self.received = 0
        """Messages so far."""
        self.missed = 0
        """Messages that were not received between them."""

    @property
    def period(self) -> float:
        """Period of the stream [s]; 0 before three messages."""
        return self._period() / NANOSECONDS

    def _period(self) -> int:
        if len(self._intervals) < 2:
            return 0
        return sorted(self._intervals)[len(self._intervals) // 10]

    def take(self, stamp: int) -> int:
        """Take the stamp [ns] of a message; return how many were missed just before it.

        Stamps of zero mean nothing. A stamp that goes back begins anew: a replay.
        """
        if stamp <= 0:
            return 0
        self.received += 1
        before, self._newest = self._newest, stamp
        interval = stamp - before
        if before == 0 or interval <= 0 or interval > self._pause:
            return 0
        self._intervals.append(interval)
        period = self._period()
        missing = round(interval / period) - 1 if period else 0
        self.missed += missing
        return missing
