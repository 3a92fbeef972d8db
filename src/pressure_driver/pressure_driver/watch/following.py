"""Do the chambers follow? Normal responses in seconds, mean values for slow leaks."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pressure_driver.watch.limits import MonitorLimits

LONGEST_DELAY = 2.0
"""[s] from a command to the pressure: 0.2 to 1.7 s in logs of a real board."""
LEAK_BLOCKS = 10
"""Parts of `MonitorLimits.leak_time`: how often leaks are looked for in that time."""
LONGEST_GAP = 1.0
"""[s] between two readings, above which the mean values begin afresh."""


def chamber_gauge(differential: Sequence[float]) -> NDArray[np.float64]:
    """Return the gauge pressures (2M,) [Pa] of pairs: one chamber vented, the other at |u|."""
    difference = np.asarray(differential, dtype=np.float64)
    return np.stack([np.maximum(difference, 0.0), np.maximum(-difference, 0.0)], axis=1).ravel()


class Following:
    """Compares what is measured with what has been commanded.

    Args:
        chamber_count: 2M.
        limits: of normal operation.
    """

    def __init__(self, chamber_count: int, limits: MonitorLimits) -> None:
        self.limits = limits
        self._outside_since: list[float | None] = [None] * chamber_count
        self._upper = np.zeros(chamber_count)
        self._lower = np.zeros(chamber_count)
        self._command = np.zeros(chamber_count)
        self._time: float | None = None
        self._leaks = LeakWatch(chamber_count, limits)

    def command(self, differential: Sequence[float], now: float) -> None:
        """Tell what has just been commanded.

        Args:
            differential: (M,) [Pa].
            now: [s] steady clock.
        """
        self._move_envelope(now)
        self._command = chamber_gauge(differential)
        self._upper = np.maximum(self._upper, self._command)
        self._lower = np.minimum(self._lower, self._command)

    def _move_envelope(self, now: float) -> None:
        """Let the slowest admissible response approach the command."""
        if self._time is not None:
            dt = max(now - self._time, 0.0)
            decay = np.exp(-dt / self.limits.slowest_vent)
            self._upper = self._command + (self._upper - self._command) * decay
            rising = np.minimum(self._lower + dt * self.limits.slowest_fill, self._command)
            self._lower = np.where(self._lower < self._command, rising, self._command)
        self._time = now

    def receive(self, gauge: NDArray[np.float64], opening: NDArray[np.float64], now: float) -> None:
        """Take a reading.

        Args:
            gauge: (2M,) [Pa] above rest; NaN while the rest is not known.
            opening: (2M,) of the inlet valves, 0 … 1; NaN where the board does not tell.
            now: [s] steady clock.
        """
        self._move_envelope(now)
        tolerance = self.limits.follow_tolerance
        outside = (gauge > self._upper + tolerance) | (gauge < self._lower - tolerance)
        for chamber, bad in enumerate(outside):
            if not bad:
                self._outside_since[chamber] = None
            elif self._outside_since[chamber] is None:
                self._outside_since[chamber] = now
        self._leaks.receive(self._lower, self._upper, gauge, opening, now)

    def restart(self, gauge: NDArray[np.float64], now: float) -> None:
        """Start afresh from what is measured now."""
        known = np.nan_to_num(gauge)
        self._upper = np.maximum(known, self._command)
        self._lower = np.minimum(known, self._command)
        self._time = now
        self._outside_since = [None] * len(known)
        self._leaks.restart()

    def faults(self, gauge: NDArray[np.float64], now: float) -> list[str]:
        """Say which chambers do not follow their commands, or lose air."""
        faults = []
        for chamber, since in enumerate(self._outside_since):
            if since is not None and now - since >= self.limits.follow_time:
                faults.append(
                    f"chamber {chamber} does not follow: {gauge[chamber]:.0f} Pa gauge, "
                    f"commanded {self._command[chamber]:.0f} Pa"
                )
        return faults + self._leaks.faults


@dataclass
class _Block:
    """Sums of the readings in one part of the leak time; arrays (2M,)."""

    since: float
    count: int = 0
    shortfall: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    excess: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    opening: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    rise: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    lowest: NDArray[np.float64] = field(default_factory=lambda: np.full(1, np.inf))
    highest: NDArray[np.float64] = field(default_factory=lambda: np.full(1, -np.inf))


class LeakWatch:
    """Finds slow leaks: chambers that stay below their commands, or must be fed all the time.

    Also chambers that stay above: a board that mistook trapped air for the room's fills them so.

    In the mean over `MonitorLimits.leak_time` the noise of a sensor vanishes. A response that comes
    by d late lies below its command by at most d / leak_time times the span of the command, in the
    mean; so much is allowed on top. To fill a chamber by r, its inlet is open for r / slowest_fill
    at the most; what it is open beyond feeds a leak.

    Args:
        chamber_count: 2M.
        limits: of normal operation.
    """

    def __init__(self, chamber_count: int, limits: MonitorLimits) -> None:
        self.faults: list[str] = []
        """What was found at the last look."""
        self._limits = limits
        self._count = chamber_count
        self._blocks: deque[_Block] = deque(maxlen=LEAK_BLOCKS)
        self._block: _Block | None = None
        self._last_at = -np.inf
        self._expected = np.zeros(chamber_count)

    def restart(self) -> None:
        """Forget all readings."""
        self.faults = []
        self._blocks.clear()
        self._block = None

    def receive(
        self,
        expected: NDArray[np.float64],
        highest: NDArray[np.float64],
        gauge: NDArray[np.float64],
        opening: NDArray[np.float64],
        now: float,
    ) -> None:
        """Take what the slowest sound valves would have reached, what is measured, and the inlets.

        Args:
            expected: (2M,) [Pa] gauge, filling.
            highest: (2M,) [Pa] gauge, venting.
            gauge: (2M,) [Pa].
            opening: (2M,) 0 … 1 or NaN.
            now: [s] steady clock.
        """
        if now - self._last_at > LONGEST_GAP or not np.isfinite(gauge).all():
            self.restart()
            self._expected = expected
        self._last_at = now
        block = self._block
        if block is None:
            block = self._block = _Block(now)
        block.count += 1
        block.shortfall = block.shortfall + (expected - gauge)
        block.excess = block.excess + (gauge - highest)
        block.opening = block.opening + opening
        block.rise = block.rise + np.maximum(expected - self._expected, 0.0)
        block.lowest = np.minimum(block.lowest, expected)
        block.highest = np.maximum(block.highest, expected)
        self._expected = expected
        if now - block.since >= self._limits.leak_time / LEAK_BLOCKS:
            self._blocks.append(block)
            self._block = None
            self._look()

    def _look(self) -> None:
        """Judge the last `LEAK_BLOCKS` blocks."""
        self.faults = []
        if len(self._blocks) < LEAK_BLOCKS:
            return
        blocks, limits = self._blocks, self._limits
        count = sum(block.count for block in blocks)
        shortfall = np.sum([block.shortfall for block in blocks], axis=0) / count
        excess = np.sum([block.excess for block in blocks], axis=0) / count
        opening = np.sum([block.opening for block in blocks], axis=0) / count
        lowest = np.min([block.lowest for block in blocks], axis=0)
        span = np.max([block.highest for block in blocks], axis=0) - lowest
        rise = np.sum([block.rise for block in blocks], axis=0)
        allowed = limits.leak_tolerance + LONGEST_DELAY / limits.leak_time * span
        fed = (lowest > limits.vented_tolerance) & (
            opening > limits.leak_opening + rise / (limits.slowest_fill * limits.leak_time)
        )
        mean = f"in the mean of {limits.leak_time:g} s"
        told = f"{mean} ('leak_tolerance' allows {limits.leak_tolerance:.0f} Pa)"
        for chamber in range(self._count):
            name, short, over = f"chamber {chamber}", shortfall[chamber], excess[chamber]
            if short > allowed[chamber]:
                self.faults.append(f"{name} loses air: {short:.0f} Pa below its command {told}")
            elif fed[chamber]:
                self.faults.append(
                    f"{name} loses air: its inlet valve was open by {opening[chamber]:.0%} {mean} "
                    f"('leak_opening' allows {limits.leak_opening:.0%} at steady pressure)"
                )
            if over > allowed[chamber] and lowest[chamber] > limits.vented_tolerance:
                self.faults.append(
                    f"{name} is filled too high: {over:.0f} Pa above its command {told}; a board "
                    "that started under pressure must be powered anew with vented chambers"
                )
