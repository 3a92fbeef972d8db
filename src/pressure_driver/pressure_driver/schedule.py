"""Timed setpoints, and the grid of ticks at which they take effect.

The clock is whatever the caller passes in as nanoseconds. A setpoint takes effect at the first tick
at or after its stamp.
"""

from __future__ import annotations

import bisect
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

from pressure_driver.settings import NANOSECONDS, Settings

CAPACITY = 4096
"""Setpoints that may wait."""
REMEMBERED_PLANS = 256
"""Plans that have been replaced and are still known as such."""


class Verdict(Enum):
    """What became of an offered setpoint."""

    ACCEPTED = "accepted"
    LATE = "late"
    DUPLICATE = "duplicate"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class Setpoint:
    """Differential pressures and the instant at which they take effect."""

    stamp: int
    """[ns] of the wall clock."""
    differential: tuple[float, ...]
    """(M,) [Pa]."""
    plan_id: str = ""
    index: int = 0
    revision: int = 0
    """Replaces a lower one of the same plan, index and stamp."""


class Sample(NamedTuple):
    """What the schedule asks for at one tick."""

    setpoint: Setpoint
    """The one in force."""
    differential: tuple[float, ...]
    """(M,) [Pa] its pressures, or interpolated toward the next."""
    fresh: bool
    """The setpoint came into force at this tick, or the value moves toward the next."""


@dataclass
class Counters:
    """What happened to setpoints since the start."""

    accepted: int = 0
    executed: int = 0
    late: int = 0
    duplicate: int = 0
    refused: int = 0
    superseded: int = 0
    """Accepted, but replaced by a new plan, by a revision or by a later one in the same tick."""
    missing: int = 0
    """Places of a plan, counted by `index`, that were not there when a later one took effect."""


class SetpointSchedule:
    """A buffer of timed setpoints with zero-order hold or linear interpolation.

    Args:
        settings: the ticks, and what every setpoint is checked against.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.period = settings.period
        self.counters = Counters()
        self.reason = ""
        """Why the last setpoint that was not accepted was not."""
        self._waiting: list[Setpoint] = []
        self._current: Setpoint | None = None
        self._last_tick = -(2**62)
        self._replaced: deque[str] = deque(maxlen=REMEMBERED_PLANS)

    @property
    def waiting(self) -> int:
        """How many setpoints have not come into force yet."""
        return len(self._waiting)

    @property
    def current(self) -> Setpoint | None:
        """The setpoint in force."""
        return self._current

    def clear(self) -> None:
        """Forget everything that waits and what is in force."""
        self._waiting.clear()
        self._current = None
        self._replaced.clear()

    def offer(self, setpoint: Setpoint, now: int, held: Sequence[float]) -> Verdict:
        """Check a setpoint and keep it until its stamp.

        Args:
            setpoint: stamp 0 means now.
            now: [ns] wall clock.
            held: (M,) [Pa] in force at present, from which the slew of a first one is taken.

        Returns:
            What became of it; `reason` says why unless it was accepted.
        """
        verdict, reason = self._judge(setpoint, now, held)
        if verdict is Verdict.ACCEPTED:
            self.counters.accepted += 1
            return verdict
        plan = f" of '{setpoint.plan_id}'" if setpoint.plan_id else ""
        self.reason = f"setpoint {setpoint.index}{plan}: {reason}"
        if verdict is Verdict.LATE:
            self.counters.late += 1
        elif verdict is Verdict.DUPLICATE:
            self.counters.duplicate += 1
        else:
            self.counters.refused += 1
        return verdict

    def refuse(self, reason: str) -> Verdict:
        """Count a setpoint that was refused for a reason outside the schedule."""
        self.counters.refused += 1
        self.reason = reason
        return Verdict.REFUSED

    def _judge(self, setpoint: Setpoint, now: int, held: Sequence[float]) -> tuple[Verdict, str]:
        if problem := self._value_problem(setpoint):
            return Verdict.REFUSED, problem
        untimed = setpoint.stamp == 0
        if untimed:
            # "Now" is the next tick, whatever the grid has already done.
            stamp = max(self._tick_of(now), self._last_tick + self.period)
            setpoint = replace(setpoint, stamp=stamp)
        ahead = (setpoint.stamp - now) / NANOSECONDS
        if ahead > self.settings.horizon:
            return Verdict.REFUSED, (
                f"{ahead:.2f} s ahead, the limit is {self.settings.horizon:g} s"
            )
        if self._tick_of(setpoint.stamp) <= self._last_tick:
            return Verdict.LATE, f"came {-ahead * 1000:.1f} ms after its stamp"
        return self._insert(setpoint, held, untimed)

    def _value_problem(self, setpoint: Setpoint) -> str:
        values = setpoint.differential
        if len(values) != self.settings.segment_count:
            return f"has {len(values)} pressures, expected {self.settings.segment_count}"
        if not all(math.isfinite(value) for value in values):
            return f"is not finite: {list(values)}"
        worst = max(values, key=abs)
        if abs(worst) > self.settings.pressure_limit:
            return f"asks for {worst:.0f} Pa, the limit is ±{self.settings.pressure_limit:.0f} Pa"
        return ""

    def _insert(
        self, setpoint: Setpoint, held: Sequence[float], untimed: bool
    ) -> tuple[Verdict, str]:
        """Put a setpoint into its place; of two for the same instant, the newest untimed wins."""
        place = self._place(setpoint.stamp)
        same_stamp = place < len(self._waiting) and self._waiting[place].stamp == setpoint.stamp
        replaces = not self._belongs(setpoint)
        revises = False
        if same_stamp and not replaces and not untimed:
            there = self._waiting[place]
            revises = there.index == setpoint.index and setpoint.revision > there.revision
            if not revises:
                return Verdict.DUPLICATE, (
                    f"setpoint {there.index}, revision {there.revision}, has the same stamp"
                )
        if setpoint.plan_id in self._replaced:
            return Verdict.REFUSED, "this plan has been replaced by a newer one"
        if len(self._waiting) >= CAPACITY and not replaces:
            return Verdict.REFUSED, f"{len(self._waiting)} setpoints are waiting already"
        before = self._waiting[place - 1] if place else None
        following = place + 1 if same_stamp else place
        after = None if replaces or following >= len(self._waiting) else self._waiting[following]
        if revises:
            after = (
                None  # the next one is about to be revised as well; the output is limited anyway
            )
        if problem := self._slew_problem(before, setpoint, held) or (
            self._slew_problem(setpoint, after, held) if after else ""
        ):
            return Verdict.REFUSED, problem
        if replaces:
            self._replace_from(place)
        elif same_stamp:
            del self._waiting[place]
            self.counters.superseded += 1
        self._waiting.insert(place, setpoint)
        return Verdict.ACCEPTED, ""

    def _place(self, stamp: int) -> int:
        """Return where a stamp belongs among those that wait; mostly at the end."""
        if not self._waiting or self._waiting[-1].stamp < stamp:
            return len(self._waiting)
        return bisect.bisect_left(self._waiting, stamp, key=lambda item: item.stamp)

    def _replace_from(self, place: int) -> None:
        """Drop what an older plan had from this place on, and let it say no more."""
        newest = self._waiting[-1] if self._waiting else self._current
        self.counters.superseded += len(self._waiting) - place
        del self._waiting[place:]
        if newest is not None and newest.plan_id:
            self._replaced.append(newest.plan_id)

    def _belongs(self, setpoint: Setpoint) -> bool:
        """Tell whether the newest known setpoint is of the same plan."""
        newest = self._waiting[-1] if self._waiting else self._current
        return newest is None or newest.plan_id == setpoint.plan_id

    def _slew_problem(self, before: Setpoint | None, after: Setpoint, held: Sequence[float]) -> str:
        if before is None:
            reference, gap = held, self.period
            if self._current is not None:
                gap = max(after.stamp - self._current.stamp, self.period)
                gap = min(gap, 2 * self.period)
        else:
            reference, gap = before.differential, after.stamp - before.stamp
        duration = max(gap, self.period) / NANOSECONDS
        slew = max(abs(a - b) for a, b in zip(after.differential, reference, strict=True))
        slew /= duration
        if slew > self.settings.slew_limit * (1.0 + 1e-9):
            return f"changes by {slew:.0f} Pa/s, the limit is {self.settings.slew_limit:.0f} Pa/s"
        return ""

    def _tick_of(self, stamp: int) -> int:
        """Return the first tick at or after a stamp."""
        return -(-stamp // self.period) * self.period

    def sample(self, tick: int, held: Sequence[float] = ()) -> Sample | None:
        """Bring into force what is due at a tick.

        Args:
            tick: [ns]; ticks must not go backward (see `forget_ticks`).
            held: (M,) [Pa] what was commanded at the last tick. Interpolation goes on from there,
                so that pressures which were let down or limited meanwhile do not come back at
                once. Empty: the last setpoint's.

        Returns:
            What to command, or None before the first setpoint.
        """
        self._last_tick = max(self._last_tick, tick)
        due = 0
        while due < len(self._waiting) and self._waiting[due].stamp <= tick:
            self._count_missing(
                self._waiting[due - 1] if due else self._current, self._waiting[due]
            )
            due += 1
        if due:
            self._current = self._waiting[due - 1]
            del self._waiting[:due]
            self.counters.executed += 1
            self.counters.superseded += due - 1
        current = self._current
        if current is None:
            return None
        if self.settings.interpolation == "hold" or not self._waiting:
            return Sample(current, current.differential, fresh=bool(due))
        if due or not held:
            begin, start = current.stamp, current.differential
        else:
            begin, start = tick - self.period, tuple(held)
        following = self._waiting[0]
        share = (tick - begin) / (following.stamp - begin)
        moved = tuple(
            a + share * (b - a) for a, b in zip(start, following.differential, strict=True)
        )
        return Sample(current, moved, fresh=True)

    def _count_missing(self, before: Setpoint | None, after: Setpoint) -> None:
        """Count the places of one plan that are not there between two setpoints in force."""
        if before is not None and before.plan_id and before.plan_id == after.plan_id:
            self.counters.missing += max(after.index - before.index - 1, 0)

    def forget_ticks(self) -> None:
        """Accept earlier stamps again, as after the wall clock was set back."""
        self._last_tick = -(2**62)


class TickGrid:
    """The absolute time grid of the ticks: when the next is due, and for which instant it stands.

    Ticks fall on whole multiples of the period of the wall clock that stamps messages (ROS time),
    so they cannot drift against the stamps. How far this clock is from the steady one is taken anew
    at every tick, so that a clock that is slewed or set moves the grid by itself.

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
