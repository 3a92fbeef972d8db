"""Does a chamber follow its commands? A normal response in seconds, mean values for slow leaks."""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Iterator, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pressure_driver.settings import Settings


LONGEST_DELAY = 2.0
"""[s] from a command to the pressure: 0.2 to 1.7 s in logs of a real board."""
LEAK_LOOKS = 10
"""How often leaks are looked for in the parameter `leak_time`."""
LONGEST_GAP = 1.0
"""[s] between two readings, above which the mean values begin afresh."""


def chamber_gauge(differential: Sequence[float]) -> list[float]:
    """Return the gauge pressures (2M,) [Pa] of pairs: one chamber vented, the other at |u|."""
    return [gauge for value in differential for gauge in (max(value, 0.0), max(-value, 0.0))]


class Duration:
    """How long something has gone on without a break."""

    def __init__(self) -> None:
        self._since = math.inf

    def note(self, goes_on: bool, now: float) -> None:
        """Tell whether it goes on now (steady clock [s])."""
        self._since = min(self._since, now) if goes_on else math.inf

    def until(self, now: float) -> float:
        """Return for how long [s]; −inf if it does not go on."""
        return now - self._since


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
        self._time = math.inf
        self._outside = Duration()
        self._leaks = LeakWatch(self._name, settings)

    def command(self, pressure: float, now: float) -> None:
        """Tell what has just been commanded (steady clock [s])."""
        self._move_envelope(now)
        self._command = pressure
        self._upper = max(self._upper, pressure)
        self._lower = min(self._lower, pressure)

    def _move_envelope(self, now: float) -> None:
        """Let the slowest admissible response approach the command."""
        passed = max(now - self._time, 0.0)
        decay = math.exp(-passed / self._settings.slowest_vent)
        self._upper = self._command + (self._upper - self._command) * decay
        self._lower = min(self._lower + passed * self._settings.slowest_fill, self._command)
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
        outside = gauge > self._upper + tolerance or gauge < self._lower - tolerance
        self._outside.note(outside, now)
        self._leaks.receive(Reading(now, self._lower, self._upper, gauge, opening))

    def restart(self, gauge: float, now: float) -> None:
        """Start afresh from what is measured now."""
        known = 0.0 if math.isnan(gauge) else gauge
        self._upper = max(known, self._command)
        self._lower = min(known, self._command)
        self._time = now
        self._outside.note(False, now)
        self._leaks.restart()

    def faults(self, now: float) -> Iterator[str]:
        """Say whether the chamber does not follow its command, or loses air."""
        if self._outside.until(now) >= self._settings.follow_time:
            yield (
                f"{self._name} does not follow: {self._gauge:.0f} Pa gauge, commanded "
                f"{self._command:.0f} Pa"
            )
        if self._leaks.fault:
            yield self._leaks.fault


class Reading(NamedTuple):
    """What one chamber measures, between what the slowest sound valves would have reached."""

    time: float
    """[s] steady clock."""
    lowest: float
    """[Pa] gauge, while filling."""
    highest: float
    """[Pa] gauge, while venting."""
    gauge: float
    """[Pa]."""
    opening: float
    """Of the inlet, 0 … 1 or NaN."""


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
        self._readings: deque[Reading] = deque()
        self._next_look = math.inf

    def restart(self) -> None:
        """Forget all readings."""
        self.fault = ""
        self._readings.clear()

    def receive(self, reading: Reading) -> None:
        """Take a reading, and look for a leak from time to time."""
        readings, leak_time = self._readings, self._settings.leak_time
        if readings and reading.time - readings[-1].time > LONGEST_GAP:
            self.restart()
        if not math.isfinite(reading.gauge):
            self.restart()
            return
        if not readings:
            self._next_look = reading.time + leak_time
        readings.append(reading)
        while reading.time - readings[0].time > leak_time:
            readings.popleft()
        if reading.time >= self._next_look:
            self._next_look += leak_time / LEAK_LOOKS
            self.fault = self._judge()

    def _judge(self) -> str:
        settings = self._settings
        _, lowest, highest, gauge, opening = zip(*self._readings, strict=True)
        shortfall = fmean(lowest) - fmean(gauge)
        excess = fmean(gauge) - fmean(highest)
        open_share = fmean(opening)
        rise = sum(max(after - before, 0.0) for before, after in itertools.pairwise(lowest))
        allowed = settings.leak_tolerance
        allowed += LONGEST_DELAY / settings.leak_time * (max(lowest) - min(lowest))
        fill_share = rise / (settings.slowest_fill * settings.leak_time)
        pressed = min(lowest) > settings.vented_tolerance
        mean = f"in the mean of {settings.leak_time:g} s"
        told = f"{mean} ('leak_tolerance' allows {settings.leak_tolerance:.0f} Pa)"
        if shortfall > allowed:
            return f"{self._name} loses air: {shortfall:.0f} Pa below its command {told}"
        if pressed and open_share > settings.leak_opening + fill_share:
            return (
                f"{self._name} loses air: its inlet valve was open by {open_share:.0%} {mean} "
                f"('leak_opening' allows {settings.leak_opening:.0%} at steady pressure)"
            )
        if pressed and excess > allowed:
            return (
                f"{self._name} is filled too high: {excess:.0f} Pa above its command {told}; a "
                "board that started under pressure must be powered anew with vented chambers"
            )
        return ""
