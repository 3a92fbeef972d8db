"""The absolute time grid of the driver's ticks.

Ticks fall on whole multiples of the period of the wall clock that stamps messages (ROS time), not
at a period after the last tick, so they cannot drift against the stamps. Waiting is done on the
steady clock; how far the two clocks are apart is taken anew at every tick, so that a clock that is
slewed or stepped (NTP) moves the grid by itself.
"""

from __future__ import annotations

NANOSECONDS = 1_000_000_000


class TickGrid:
    """Tells when the next tick is due, and for which instant it stands.

    Args:
        period: [ns] between ticks.

    Raises:
        ValueError: the period is not positive.
    """

    def __init__(self, period: int) -> None:
        if period <= 0:
            raise ValueError(f"the tick period must be positive, got {period} ns")
        self.period = period
        self.missed = 0
        """Ticks that were skipped since the thread woke more than a period late."""
        self.clock_steps = 0
        """Times that the wall clock jumped by more than a period against the steady clock."""
        self._last: int | None = None
        self._offset: int | None = None

    def next_tick(self, wall: int) -> int:
        """Return the wall time [ns] of the next tick, given the wall time now."""
        following = (wall // self.period + 1) * self.period
        if self._last is None:
            return following
        return max(self._last + self.period, self._floor(wall))

    def delay(self, wall: int) -> float:
        """Return the time [s] from now to the next tick; zero or less if it is due.

        Never more than a period: a wall clock that was set back must not stop the ticks.
        """
        return min(self.next_tick(wall) - wall, self.period) / NANOSECONDS

    def take(self, wall: int, steady: int) -> int | None:
        """Return the instant [ns] of the tick that is due now, or None if none is.

        Args:
            wall: [ns] the clock that stamps messages, now.
            steady: [ns] the steady clock, now.
        """
        self._watch_steps(wall, steady)
        if self._last is None:
            if self._offset is None:
                self._offset = wall - steady
            self._last = self._floor(wall)
            return None
        due = self._floor(wall)
        if due <= self._last:
            return None
        self.missed += (due - self._last) // self.period - 1
        self._last = due
        return due

    def _floor(self, wall: int) -> int:
        return wall // self.period * self.period

    def _watch_steps(self, wall: int, steady: int) -> None:
        offset = wall - steady
        if self._offset is not None and abs(offset - self._offset) > self.period:
            self.clock_steps += 1
            self._last = self._floor(wall)
        self._offset = offset
