"""Keep a simulation in step with the steady clock, without ever running after a long delay."""

from __future__ import annotations

import time
from collections.abc import Callable

BACKLOG = 0.25
"""Longest delay that is caught up [s]; time beyond it is dropped and counted."""
TICKS_PER_PERIOD = 4


class RealTimeLoop:
    """Advances a simulation by the steady time that has passed and publishes on a fixed grid.

    Args:
        advance: called with a duration to simulate [s].
        publish: called once a period with the age of the simulated state [s].
        period: of publishing [s].
        clock: steady clock that measures the cost of a call [s].

    Attributes:
        capacity: simulated time per time spent in `advance`, smoothed; the margin over real time.
        busy: share of one core spent in `advance` and `publish`, smoothed.
        lag: how late the last tick was [s].
        dropped: time that was never simulated [s].
        behind: time was dropped within the last seconds.
    """

    def __init__(
        self,
        advance: Callable[[float], None],
        publish: Callable[[float], None],
        period: float,
        clock: Callable[[], float] | None = None,
    ) -> None:
        self._advance = advance
        self._publish = publish
        self._period = period
        self._clock = clock or time.monotonic
        self._begin = self._simulated_until = 0.0
        self._next_publish = 0.0
        self._started = False
        self._spent = self._covered = 0.0
        self._last_drop = -1e9
        self.capacity = 0.0
        self.busy = 0.0
        self.lag = 0.0
        self.dropped = 0.0
        self.behind = False

    @property
    def simulated_until(self) -> float:
        """Steady time up to which was simulated [s]."""
        return self._simulated_until

    @property
    def real_time_factor(self) -> float:
        """Simulated over passed time since the start; 1 when nothing was dropped."""
        passed = self._simulated_until - self._begin
        return 1.0 - self.dropped / passed if passed > 0 else 1.0

    def tick(self, now: float) -> float:
        """Simulate up to ``now`` [s, steady], publish if due, return the time to sleep [s]."""
        if not self._started:
            self._begin = self._simulated_until = self._next_publish = now
            self._started = True
        passed = now - self._simulated_until
        self.lag = max(0.0, passed - self._period / TICKS_PER_PERIOD)
        if passed > BACKLOG:
            self.dropped += passed - BACKLOG
            self._simulated_until = now - BACKLOG
            self._last_drop = now
            passed = BACKLOG
        self.behind = now - self._last_drop < 5.0
        begin = self._clock()
        if passed > 0:
            self._advance(passed)
            self._simulated_until = now
        spent = self._clock() - begin
        if now >= self._next_publish:
            self._publish(self._clock() - begin)
            while self._next_publish <= now:
                self._next_publish += self._period
        self._account(passed, spent, self._clock() - begin)
        wake = min(now + self._period / TICKS_PER_PERIOD, self._next_publish)
        return max(0.0, wake - now - (self._clock() - begin))

    def _account(self, passed: float, stepping: float, total: float) -> None:
        fade = 0.98
        self._covered = fade * self._covered + passed
        self._spent = fade * self._spent + stepping
        if self._spent > 0:
            self.capacity = self._covered / self._spent
        if self._covered > 0:
            share = total / max(passed, 1e-9)
            self.busy = fade * self.busy + (1 - fade) * share
