"""The schedules that the planner plays, from their planning to their end."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from typing import Protocol

from der_msgs.msg import PressureState
from der_planner.nodes.driver_watch import DriverWatch, Ending
from der_planner.planning.result import Plan
from der_planner.planning.streaming import GRID, Player, Schedule, first_stamp

_MARGIN = 100_000_000
"""A plan starts this much [ns] after the earliest instant, so that its message travels first."""


class Audience(Protocol):
    """Is told what becomes of the schedules; called from the executor's or the player's thread."""

    def scheduled(self, schedule: Schedule) -> None:
        """A plan has its instant; nothing of it was sent yet."""

    def send(self, schedule: Schedule, index: int) -> None:
        """One setpoint is due to be sent."""

    def abandoned(self, plan_id: str, ending: Ending) -> None:
        """Everything is to be stopped, because of the driver."""

    def ended(self, schedule: Schedule, outcome: str, reason: str) -> None:
        """A plan is over."""


class Stage:
    """Plays schedules through a `Player` as long as the driver takes setpoints.

    Args:
        audience: is told.
        driver: what is known of the driver.
        now: present ROS time [ns].
        lead: how long before its stamp a setpoint is sent [ns].
    """

    def __init__(
        self, audience: Audience, driver: DriverWatch, now: Callable[[], int], lead: int
    ) -> None:
        self._audience, self._driver, self._now, self._lead = audience, driver, now, lead
        self.lock = threading.RLock()
        """Held where playing begins and where it is ended."""
        self._open: list[Schedule] = []  # played, or waiting for their start; oldest first
        self._spent: set[str] = set()
        self._player = Player(now, self._send, lambda _: None, lead)

    @property
    def position(self) -> tuple[Schedule, int] | None:
        """The schedule in force and the index of its next setpoint, or None."""
        return self._player.position

    @property
    def busy(self) -> bool:
        """Whether a plan is played or waits for its start."""
        return bool(self._open)

    def find(self, plan_id: str) -> Schedule | None:
        """Return the schedule of a plan that is not over."""
        return next((s for s in self._open if s.plan_id == plan_id), None)

    def is_spent(self, plan_id: str) -> bool:
        """Tell whether the driver ended this plan: it takes no more setpoints of it."""
        return plan_id in self._spent

    def unspent(self, plan_id: str) -> str:
        """Return the id, with a number where the driver takes no more setpoints of it."""
        names = itertools.chain([plan_id], (f"{plan_id}-{n}" for n in itertools.count(2)))
        return next(name for name in names if name not in self._spent)

    def play(self, plan_id: str, plan: Plan, start: int) -> Schedule:
        """Schedule a plan at an instant [ns], 0: as soon as possible; after what is played now."""
        with self.lock:
            margin = _MARGIN if start == 0 else 0
            earliest = first_stamp(self._now() + margin, self._lead, start)
            position = self.position
            if position is not None and plan.reference.start is None:
                earliest = max(earliest, position[0].stamp(position[0].count))
            schedule = Schedule(plan_id, plan, earliest)
            self._audience.scheduled(schedule)
            self._open.append(schedule)
            self._player.play(schedule)
        return schedule

    def stop(self, outcome: str, reason: str) -> bool:
        """Send nothing more; tell whether anything was being sent."""
        with self.lock:
            playing = self._player.stop()
            ended, self._open = self._open, []
        for schedule in ended:
            self._audience.ended(schedule, outcome, reason)
        return playing

    def take_state(self, state: PressureState) -> None:
        """Take what the driver says of itself; stop if it vents or has a fault."""
        now = self._now()
        begun = [s.plan_id for s in self._open if s.start < now]
        ending = self._driver.take(state, self.busy, begun)
        if ending is not None:
            self._abandon(ending)

    def end_what_is_over(self) -> None:
        """Call a plan finished once its last setpoint has taken effect; call it now and then."""
        now = self._now()
        with self.lock:
            over = [s for s in self._open if s.stamp(s.count - 1) <= now]
            self._open = [s for s in self._open if s not in over]
        for schedule in over:
            self._audience.ended(schedule, "finished", "")

    def close(self) -> None:
        """End the player's thread."""
        self._player.close()

    def _send(self, schedule: Schedule, index: int) -> None:
        """Send one setpoint, unless the driver takes none: then everything is stopped."""
        if schedule not in self._open:
            return
        obstacle = self._driver.obstacle()
        if obstacle is not None:
            self._abandon(obstacle)
            return
        if index == 0:
            self._replace(schedule)
        self._audience.send(schedule, index)

    def _replace(self, schedule: Schedule) -> None:
        """End the motion that a new one takes over from, if it was not played to its end."""
        with self.lock:
            before = itertools.takewhile(lambda s: s is not schedule, self._open)
            over = [s for s in before if s.stamp(s.count - 1) >= schedule.start]
            self._open = [s for s in self._open if s not in over]
        for other in over:
            self._audience.ended(other, "replaced", f"by plan {schedule.plan_id}")

    def _abandon(self, ending: Ending) -> None:
        with self.lock:
            if not self._open:
                return
            plan_id = self._open[-1].plan_id
            self._spent.update(schedule.plan_id for schedule in self._open)
            self.stop(ending.outcome, ending.reason)
        self._audience.abandoned(plan_id, ending)

    def share(self, schedule: Schedule) -> str:
        """Return how many of a schedule's setpoints have been due by now, of how many."""
        due = min(max((self._now() - schedule.start) // GRID + 1, 0), schedule.count)
        return f"{due} of {schedule.count} setpoints"
