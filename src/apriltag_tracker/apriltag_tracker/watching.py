"""What a tracker tells of the stream that it follows: rate, latency, counts, silence."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable

import numpy as np

SILENCE = 2.0
"""Without an image or a frame of poses for this long [s] something is wrong."""
_CLOCKS_APART = 5.0
"""No state is this late or early [s] by one clock."""
_WINDOW = 300


class StreamWatch:
    """Counts what comes and the states that are made of it, and tells of silence.

    Args:
        source: where it comes from, for the messages: a topic's name, a device or a file.
        noun: what comes: ``image`` or ``frame``.
        clock: a steady clock [s].
    """

    def __init__(self, source: str, noun: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._source = source
        self._noun = noun
        self._clock = clock
        self._started = clock()
        self.received = self.processed = self.failed = 0
        self.repeated = self.invalid = self.bridged = 0
        self._arrivals: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._stamp, self._again = -1, 0
        """The last stamp [ns], and how often it came again."""
        self._latency: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._work: collections.deque[float] = collections.deque(maxlen=_WINDOW)

    def arrived(self, stamp: int) -> bool:
        """One came that has a stamp [ns], zero: none; tell whether the one before had another."""
        self.received += 1
        self._arrivals.append(self._clock())
        self._again = self._again + 1 if stamp == self._stamp else 0
        self._stamp = stamp
        self.repeated += self._again > 0
        return self._again == 0

    def counted(self, valid: bool, bridged: bool, latency: float, work: float) -> None:
        """One was processed; latency from its stamp and time of the work in s."""
        self.processed += 1
        self.invalid += not valid
        self.bridged += bridged
        self._latency.append(latency)
        self._work.append(work)

    def silence(self) -> tuple[str, str] | None:
        """Return the level and what to say of a stream that is silent.

        The level is ``stale`` before the first, ``error`` for a stream that stopped.
        """
        silent = self._clock() - (self._arrivals[-1] if self._arrivals else self._started)
        if self._arrivals and silent <= SILENCE:
            return None
        said = f"no {self._noun} from {self._source} for {silent:.0f} s"
        return "error" if self._arrivals else "stale", said

    def other_clock(self) -> str:
        """Return what to say of stamps that are no times of this computer; empty if they are."""
        late = float(np.median(self._latency)) if self._latency else 0.0
        if abs(late) < _CLOCKS_APART:
            return ""
        return f"stamps from {self._source} are {late:.0f} s old: are they of another clock?"

    def values(self) -> dict[str, object]:
        """Return the numbers by name."""
        values: dict[str, object] = {
            f"{self._noun}s_received": self.received,
            f"{self._noun}s_processed": self.processed,
            f"{self._noun}s_failed": self.failed,
            "repeated_stamps": self.repeated,
            "states_invalid": self.invalid,
            "states_bridged": self.bridged,
        }
        if len(self._arrivals) > 1 and self._arrivals[-1] > self._arrivals[0]:
            rate = (len(self._arrivals) - 1) / (self._arrivals[-1] - self._arrivals[0])
            values["rate_hz"] = f"{rate:.1f}"
        for name, kept in (("latency", self._latency), ("processing", self._work)):
            if kept:
                values[f"{name}_ms_median"] = f"{1e3 * float(np.median(kept)):.2f}"
                values[f"{name}_ms_p99"] = f"{1e3 * float(np.percentile(kept, 99)):.2f}"
        return values
