"""Does a chamber follow its commands? A normal response in seconds, mean values for slow leaks."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from pressure_driver.settings import Settings

LONGEST_DELAY = 2.0
"""[s] from a command to the pressure: 0.2 to 1.7 s in logs of a real board."""
LEAK_BLOCKS = 10
"""Parts of the parameter `leak_time`: how often leaks are looked for in that time."""
LONGEST_GAP = 1.0
"""[s] between two readings, above which the mean values begin afresh."""


def chamber_gauge(differential: Sequence[float]) -> list[float]:
    """Return the gauge pressures (2M,) [Pa] of pairs: one chamber vented, the other at |u|."""
    return [gauge for value in differential for gauge in (max(value, 0.0), max(-value, 0.0))]


class Following:
    """Compares what one chamber measures with what it has been commanded.

    All pressures are gauge pressures in Pa; NaN while the rest pressure is not known.

    Args:
        chamber: its number, for the sentences.
        settings: bounds of normal operation.
    """

    def __init__(self, chamber: int, settings: Settings) -> None:
        self._name = f"chamber {chamber}"
        self._settings = settings
        self._command = 0.0
        self._gauge = math.nan
        self._upper = self._lower = 0.0
        self._time: float | None = None
        self._outside_since: float | None = None
        self._leaks = LeakWatch(self._name, settings)

    def command(self, pressure: float, now: float) -> None:
        """Tell what has just been commanded (steady clock [s])."""
        self._move_envelope(now)
        self._command = pressure
        self._upper = max(self._upper, pressure)
        self._lower = min(self._lower, pressure)

    def _move_envelope(self, now: float) -> None:
        """Let the slowest admissible response approach the command."""
        if self._time is not None:
            passed = max(now - self._time, 0.0)
            decay = math.exp(-passed / self._settings.slowest_vent)
            self._upper = self._command + (self._upper - self._command) * decay
            risen = self._lower + passed * self._settings.slowest_fill
            self._lower = min(risen, self._command)
        self._time = now

    def receive(self, gauge: float, opening: float, now: float) -> None:
        """Take a reading.

        Args:
            gauge: [Pa] above rest.
            opening: of the inlet valve, 0 … 1; NaN where the board does not tell.
            now: [s] steady clock.
        """
        self._move_envelope(now)
        self._gauge = gauge
        tolerance = self._settings.follow_tolerance
        if not (gauge > self._upper + tolerance or gauge < self._lower - tolerance):
            self._outside_since = None
        elif self._outside_since is None:
            self._outside_since = now
        self._leaks.receive(self._lower, self._upper, gauge, opening, now)

    def restart(self, gauge: float, now: float) -> None:
        """Start afresh from what is measured now."""
        known = 0.0 if math.isnan(gauge) else gauge
        self._upper = max(known, self._command)
        self._lower = min(known, self._command)
        self._time = now
        self._outside_since = None
        self._leaks.restart()

    def faults(self, now: float) -> Iterator[str]:
        """Say whether the chamber does not follow its command, or loses air."""
        since = self._outside_since
        if since is not None and now - since >= self._settings.follow_time:
            yield (
                f"{self._name} does not follow: {self._gauge:.0f} Pa gauge, commanded "
                f"{self._command:.0f} Pa"
            )
        if self._leaks.fault:
            yield self._leaks.fault


@dataclass
class _Block:
    """Sums over the readings in one part of the leak time."""

    since: float
    count: int = 0
    shortfall: float = 0.0
    excess: float = 0.0
    opening: float = 0.0
    rise: float = 0.0
    lowest: float = math.inf
    highest: float = -math.inf


class LeakWatch:
    """Finds slow leaks: a chamber that stays below its command, or must be fed all the time.

    Also a chamber that stays above: a board that mistook trapped air for the room's fills it so.

    In the mean over `leak_time` the noise of a sensor vanishes. A response that comes by d late
    lies below its command by at most d / leak_time times the span of the command, in the mean; so
    much is allowed on top. To fill a chamber by r, its inlet is open for r / slowest_fill at the
    most; what it is open beyond feeds a leak.
    """

    def __init__(self, name: str, settings: Settings) -> None:
        self.fault = ""
        """What was found at the last look."""
        self._name = name
        self._settings = settings
        self._blocks: deque[_Block] = deque(maxlen=LEAK_BLOCKS)
        self._block: _Block | None = None
        self._last_at = -math.inf
        self._expected = 0.0

    def restart(self) -> None:
        """Forget all readings."""
        self.fault = ""
        self._blocks.clear()
        self._block = None

    def receive(
        self, expected: float, highest: float, gauge: float, opening: float, now: float
    ) -> None:
        """Take what the slowest sound valves would have reached, and what is measured.

        Args:
            expected: [Pa] gauge, while filling.
            highest: [Pa] gauge, while venting.
            gauge: [Pa].
            opening: of the inlet, 0 … 1 or NaN.
            now: [s] steady clock.
        """
        if now - self._last_at > LONGEST_GAP or not math.isfinite(gauge):
            self.restart()
            self._expected = expected
        self._last_at = now
        block = self._block = self._block or _Block(now)
        block.count += 1
        block.shortfall += expected - gauge
        block.excess += gauge - highest
        block.opening += opening
        block.rise += max(expected - self._expected, 0.0)
        block.lowest = min(block.lowest, expected)
        block.highest = max(block.highest, expected)
        self._expected = expected
        if now - block.since >= self._settings.leak_time / LEAK_BLOCKS:
            self._blocks.append(block)
            self._block = None
            self.fault = self._judge() if len(self._blocks) == LEAK_BLOCKS else ""

    def _judge(self) -> str:
        blocks, settings = self._blocks, self._settings
        count = sum(block.count for block in blocks)
        shortfall = sum(block.shortfall for block in blocks) / count
        excess = sum(block.excess for block in blocks) / count
        opening = sum(block.opening for block in blocks) / count
        rise = sum(block.rise for block in blocks)
        lowest = min(block.lowest for block in blocks)
        span = max(block.highest for block in blocks) - lowest
        allowed = settings.leak_tolerance + LONGEST_DELAY / settings.leak_time * span
        fill_share = rise / (settings.slowest_fill * settings.leak_time)
        pressed = lowest > settings.vented_tolerance
        mean = f"in the mean of {settings.leak_time:g} s"
        told = f"{mean} ('leak_tolerance' allows {settings.leak_tolerance:.0f} Pa)"
        if shortfall > allowed:
            return f"{self._name} loses air: {shortfall:.0f} Pa below its command {told}"
        if pressed and opening > settings.leak_opening + fill_share:
            return (
                f"{self._name} loses air: its inlet valve was open by {opening:.0%} {mean} "
                f"('leak_opening' allows {settings.leak_opening:.0%} at steady pressure)"
            )
        if pressed and excess > allowed:
            return (
                f"{self._name} is filled too high: {excess:.0f} Pa above its command {told}; a "
                "board that started under pressure must be powered anew with vented chambers"
            )
        return ""
