"""Which setpoints are taken, when they take effect, and the grid of ticks at which they do.

The wall clock is whatever the caller passes in as nanoseconds. A setpoint takes effect at the first
tick at or after its stamp.
"""

from __future__ import annotations

import bisect
import math
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from pressure_driver.settings import Settings


NANOSECONDS = 1_000_000_000
CAPACITY = 4096
"""Setpoints that may wait."""
REMEMBERED_PLANS = 256
"""Plans that have been replaced, or were heard before the last arming, and are known as such."""
REMEMBERED_PUBLISHERS = 16
"""Refused publishers whose newest message is remembered."""
RELEASE_TIME = 1.0
"""[s] of silence after which hand-typed setpoints, which have no plan, are taken again."""


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


class SetpointSchedule:
    """A buffer of timed setpoints, each in force until the next.

    Args:
        settings: the ticks, and what every setpoint is checked against.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings = settings
        self.period = round(NANOSECONDS / settings.rate)
        """[ns] of the ticks."""
        self.counts: Counter[str] = Counter()
        """Setpoints since the start by verdict; also those ``executed``, and ``superseded`` by a
        new plan, by a revision or by a later one in the same tick."""
        self.reason = ""
        """Why the last setpoint that was not accepted was not."""
        self._waiting: list[Setpoint] = []
        self.current: Setpoint | None = None
        """The setpoint in force."""
        self._last_tick = -(2**62)
        self._replaced: deque[str] = deque(maxlen=REMEMBERED_PLANS)

    @property
    def waiting(self) -> int:
        """How many setpoints have not come into force yet."""
        return len(self._waiting)

    def clear(self) -> None:
        """Forget everything that waits and what is in force."""
        self._waiting.clear()
        self.current = None
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
        return self._count(setpoint, *self._judge(setpoint, now, held))

    def refuse(self, setpoint: Setpoint, reason: str) -> Verdict:
        """Count a setpoint that was refused for a reason outside the schedule."""
        return self._count(setpoint, Verdict.REFUSED, reason)

    def _count(self, setpoint: Setpoint, verdict: Verdict, reason: str) -> Verdict:
        self.counts[verdict.value] += 1
        if verdict is not Verdict.ACCEPTED:
            plan = f" of '{setpoint.plan_id}'" if setpoint.plan_id else ""
            self.reason = f"setpoint {setpoint.index}{plan}: {reason}"
        return verdict

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
        waiting = self._waiting
        place = bisect.bisect_left(waiting, setpoint.stamp, key=lambda item: item.stamp)
        same_stamp = place < len(waiting) and waiting[place].stamp == setpoint.stamp
        newest = waiting[-1] if waiting else self.current
        replaces = newest is not None and newest.plan_id != setpoint.plan_id
        revises = False
        if same_stamp and not replaces and not untimed:
            there = waiting[place]
            revises = there.index == setpoint.index and setpoint.revision > there.revision
            if not revises:
                return Verdict.DUPLICATE, (
                    f"setpoint {there.index}, revision {there.revision}, has the same stamp"
                )
        if setpoint.plan_id in self._replaced:
            return Verdict.REFUSED, "this plan has been replaced by a newer one"
        if len(waiting) >= CAPACITY and not replaces:
            return Verdict.REFUSED, f"{len(waiting)} setpoints are waiting already"
        before = waiting[place - 1] if place else None
        problem = self._slew_problem(before, setpoint, held)
        following = place + 1 if same_stamp else place
        # Behind a revision, the next one is about to be revised as well.
        if not problem and not replaces and not revises and following < len(waiting):
            problem = self._slew_problem(setpoint, waiting[following], held)
        if problem:
            return Verdict.REFUSED, problem
        if replaces and newest is not None and newest.plan_id:
            self._replaced.append(newest.plan_id)
        end = len(waiting) if replaces else following
        self.counts["superseded"] += end - place
        waiting[place:end] = [setpoint]
        return Verdict.ACCEPTED, ""

    def _slew_problem(self, before: Setpoint | None, after: Setpoint, held: Sequence[float]) -> str:
        if before is None:
            reference, gap = held, self.period
            if self.current is not None:
                gap = min(after.stamp - self.current.stamp, 2 * self.period)
        else:
            reference, gap = before.differential, after.stamp - before.stamp
        slew = max(abs(a - b) for a, b in zip(after.differential, reference, strict=True))
        slew /= max(gap, self.period) / NANOSECONDS
        if slew > self.settings.slew_limit * (1.0 + 1e-9):
            return f"changes by {slew:.0f} Pa/s, the limit is {self.settings.slew_limit:.0f} Pa/s"
        return ""

    def _tick_of(self, stamp: int) -> int:
        """Return the first tick at or after a stamp."""
        return -(-stamp // self.period) * self.period

    def take(self, tick: int) -> Setpoint | None:
        """Bring into force what is due at a tick, and return it.

        Args:
            tick: [ns]; ticks must not go backward (see `forget_ticks`).
        """
        self._last_tick = max(self._last_tick, tick)
        due = bisect.bisect_right(self._waiting, tick, key=lambda item: item.stamp)
        if not due:
            return None
        self.current = self._waiting[due - 1]
        del self._waiting[:due]
        self.counts["executed"] += 1
        self.counts["superseded"] += due - 1
        return self.current

    def forget_ticks(self) -> None:
        """Accept earlier stamps again, as after the wall clock was set back."""
        self._last_tick = -(2**62)


# ------------------------------------------------------------------------- whose are taken


class Origin(NamedTuple):
    """Where a setpoint came from.

    A publisher is told by the numbers that it counts its messages with: the middleware of ROS 2
    Jazzy hands these to a node, and not the publisher's identity.
    """

    topic: str
    number: int
    """The publisher's own count of its messages."""
    alone: bool
    """The topic has no other publisher."""


class PublisherGate:
    """Keeps to the publisher that is heard first after an arming, until the next arming."""

    def __init__(self) -> None:
        self.refused = 0
        """Setpoints of other publishers since the start."""
        self.release()

    def release(self) -> None:
        """Take whoever is heard next: the driver has been armed."""
        self._owner: Origin | None = None
        self._in_step = False
        self._others: deque[tuple[str, int]] = deque(maxlen=REMEMBERED_PUBLISHERS)

    def refuse(self, origin: Origin) -> str:
        """Return why a setpoint from there is not taken, or nothing if it is."""
        owner = self._owner or origin._replace(number=origin.number - 1)
        ahead = origin.number - owner.number if origin.topic == owner.topic else -1
        repeats, is_next, skips = ahead == 0, ahead == 1, ahead > 1
        before = (origin.topic, origin.number - 1)
        # A number that two publishers have reached does not tell any more which of them goes on.
        if repeats or (is_next and before in self._others):
            self._in_step = True
        if not self._in_step and (is_next or (skips and origin.alone)):
            self._owner = origin
            return ""
        self.refused += 1
        if self._in_step:
            return "two publishers have counted in step: play one alone, and arm again"
        if before in self._others:
            self._others.remove(before)
        self._others.append((origin.topic, origin.number))
        if origin.alone:
            return f"the publisher on '{owner.topic}' that was heard first has ended: arm again"
        return f"another publisher on '{owner.topic}' is being played: stop it and arm again"


class SpentPlans:
    """Remembers what was heard before the last arming, so that it does not go on after it."""

    def __init__(self) -> None:
        self._heard: deque[str] = deque(maxlen=REMEMBERED_PLANS)
        self._spent: deque[str] = deque(maxlen=REMEMBERED_PLANS)
        self._unnamed_at = -math.inf
        self._unnamed_are_spent = False

    def hear(self, plan_id: str, now: float) -> None:
        """Note the plan of a setpoint, empty for hand-typed ones (steady clock [s])."""
        if not plan_id:
            self._unnamed_at = now
        elif plan_id not in self._heard:
            self._heard.append(plan_id)

    def spend(self) -> None:
        """Refuse from now on whatever has been heard until now."""
        self._spent += [plan_id for plan_id in self._heard if plan_id not in self._spent]
        self._heard.clear()
        self._unnamed_are_spent = True

    def refuse(self, plan_id: str, now: float) -> str:
        """Return why a plan is not taken after this arming, or nothing if it is."""
        if plan_id in self._spent:
            return "this plan was sent before the driver was armed: send a new plan"
        if plan_id or not self._unnamed_are_spent:
            return ""
        self._unnamed_are_spent = now - self._unnamed_at < RELEASE_TIME
        if not self._unnamed_are_spent:
            return ""
        self._unnamed_at = now
        return (
            "setpoints without a plan have gone on since before the driver was armed: "
            f"stop them for {RELEASE_TIME:g} s"
        )


# ---------------------------------------------------------------------------------- clocks


class TickGrid:
    """The absolute time grid of the ticks: when the next is due, and for which instant it stands.

    Ticks fall on whole multiples of the period of the wall clock that stamps messages (ROS time),
    so they cannot drift against the stamps. A clock that is slewed or set moves the grid.

    Args:
        period: [ns] between ticks.
    """

    def __init__(self, period: int) -> None:
        self.period = period
        self.missed = 0
        """Ticks that were skipped since the process woke more than a period late."""
        self._last: int | None = None

    def delay(self, wall: int) -> float:
        """Return the time [s] from a wall time [ns] to the next tick; zero or less if it is due.

        Never more than a period: a wall clock that was set back must not stop the ticks.
        """
        before = wall // self.period * self.period if self._last is None else self._last
        return min(before + self.period - wall, self.period) / NANOSECONDS

    def take(self, wall: int) -> int | None:
        """Return the instant [ns] of the tick that is due at a wall time, or None if none is."""
        due = wall // self.period * self.period
        if self._last is None:
            self._last = due
            return None
        steps = (due - self._last) // self.period
        if steps in (-1, 0):  # not due yet, or a clock that was slewed back by a little
            return None
        self._last = due
        self.missed += max(steps - 1, 0)
        return due


class RunningClock:
    """The steady clock without the time in which this process was kept from running.

    Patience is counted on it, so that a machine which stands still is not taken for a board or a
    node that is silent.

    Args:
        longest_step: [s] between two calls that counts at most.
        steady: returns the steady clock [s].
    """

    def __init__(self, longest_step: float, steady: Callable[[], float]) -> None:
        self._longest_step = longest_step
        self._read_steady = steady
        self.steady = steady()
        """[s] the steady clock itself, at the last call."""
        self._now = 0.0

    def __call__(self) -> float:
        """Return the seconds that this process has been running."""
        steady = self._read_steady()
        self._now += min(steady - self.steady, self._longest_step)
        self.steady = steady
        return self._now
