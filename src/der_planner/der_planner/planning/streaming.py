"""When each setpoint is sent: schedules on the absolute 50 ms grid of ROS time, and their streamer.

This is plain Python with an injected clock and an injected sender; the planner node gives it ROS
time and publishers. Every setpoint is sent a fixed lead before its stamp, in order, from a thread
of its own, so that planning in the background does not make it late.
"""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass

from der_planner.model import CONTROL_PERIOD
from der_planner.planning.plan_file import Plan
from der_planner.planning.timing import Start

GRID = round(CONTROL_PERIOD * 1e9)
"""Setpoints are stamped on multiples of this [ns]."""
MARGIN = 100_000_000
"""A plan starts this much [ns] after the earliest instant, so that its message travels first."""


@dataclass(frozen=True, eq=False)
class Schedule:
    """A plan with the instant at which its first setpoint takes effect.

    Attributes:
        plan_id: of the plan.
        plan: the pressures.
        start: stamp of the first setpoint, a multiple of `GRID` [ns].
    """

    plan_id: str
    plan: Plan
    start: int

    def stamp(self, index: int) -> int:
        """Return the stamp of a setpoint [ns]."""
        return self.start + index * GRID

    def leave(self, stamp: int) -> Start | None:
        """Return where the motion is at an instant [ns]; None before its start, after its end."""
        index = (stamp - self.start) // GRID
        if not 0 < index < self.count:
            return None
        angles, rate, acceleration = self.plan.reference.sample(self.plan.time[index])
        return Start(angles, rate, acceleration, self.plan.differential_pressure[index - 1])

    @property
    def count(self) -> int:
        """Number of setpoints."""
        return len(self.plan.time)


def first_stamp(now: int, lead: int, wanted: int = 0) -> int:
    """Return the first multiple of `GRID` that leaves time to send ahead [ns].

    Args:
        now: present ROS time [ns].
        lead: how long before its stamp a setpoint is sent [ns].
        wanted: instant asked for [ns]; 0 or one that cannot be met: as soon as possible.
    """
    return -(-max(now + lead, wanted) // GRID) * GRID


@dataclass(frozen=True)
class Ending:
    """Why nothing may be streamed to the driver now.

    Attributes:
        outcome: vented, fault or lost: as in `der_msgs/action/PlayMotion`.
        reason: a sentence with the remedy.
    """

    outcome: str
    reason: str


class Streamer:
    """Sends the setpoints of schedules, each a lead before its stamp, while the driver takes them.

    Once a driver has vented, it refuses setpoints of that plan whatever is armed later: the ids of
    such plans are spent.

    Args:
        now: returns the present ROS time [ns].
        send: called with schedule and index for every setpoint, in order, under `lock`.
        ended: called once for every schedule, with it, the outcome and its reason, from any thread.
        obstacle: returns why the driver takes no setpoints now; None: it takes them.
        lead: [ns].

    Attributes:
        lock: whoever holds it sees no setpoint go out and no schedule end meanwhile.
    """

    def __init__(
        self,
        now: Callable[[], int],
        send: Callable[[Schedule, int], None],
        ended: Callable[[Schedule, str, str], None],
        obstacle: Callable[[], Ending | None],
        lead: int,
    ) -> None:
        self._now, self._send, self._ended, self._obstacle = now, send, ended, obstacle
        self._lead = lead
        self.lock = threading.Condition()
        self._open: list[Schedule] = []  # played, or waiting for their start; oldest first
        self._spent: set[str] = set()
        self._playing: Schedule | None = None
        self._next: Schedule | None = None
        self._index = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="setpoints", daemon=True)
        self._thread.start()

    @property
    def position(self) -> tuple[Schedule, int] | None:
        """The schedule in force and the index of its next setpoint, or None."""
        with self.lock:
            return None if self._playing is None else (self._playing, self._index)

    @property
    def busy(self) -> bool:
        """Whether a plan is played or waits for its start."""
        return bool(self._open)

    @property
    def begun(self) -> list[str]:
        """Ids of the plans whose first setpoint is due already."""
        now = self._now()
        return [schedule.plan_id for schedule in self._open if schedule.start < now]

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
        """Schedule a plan at an instant [ns], 0: as soon as possible.

        What is being played goes on until the new plan's first stamp; to its end, if the plan
        begins at rest.
        """
        with self.lock:
            playing, margin = self._playing, MARGIN if start == 0 else 0
            earliest = first_stamp(self._now() + margin, self._lead, start)
            if playing is not None and plan.reference.start is None:
                earliest = max(earliest, playing.stamp(playing.count))
            schedule = Schedule(plan_id, plan, earliest)
            self._open.append(schedule)
            if playing is None:
                self._playing, self._index = schedule, 0
            else:
                self._next = schedule
            self.lock.notify_all()
        return schedule

    def stop(self, outcome: str, reason: str) -> bool:
        """Send nothing more; tell whether anything was being sent."""
        with self.lock:
            was_playing = self._playing is not None
            self._playing = self._next = None
            self._end(self._open, outcome, reason)
        return was_playing

    def abandon(self, ending: Ending) -> None:
        """Stop because of the driver, which takes no more setpoints of these plans."""
        with self.lock:
            self.end_what_is_over()
            self._spent.update(schedule.plan_id for schedule in self._open)
            self.stop(ending.outcome, ending.reason)

    def end_what_is_over(self) -> None:
        """Call a plan finished once its last setpoint has taken effect; call it now and then."""
        now = self._now()
        with self.lock:
            self._end([s for s in self._open if s.stamp(s.count - 1) <= now], "finished", "")

    def share(self, schedule: Schedule) -> str:
        """Return how many of a schedule's setpoints have been due by now, of how many."""
        due = min(max((self._now() - schedule.start) // GRID + 1, 0), schedule.count)
        return f"{due} of {schedule.count} setpoints"

    def close(self) -> None:
        """End the thread."""
        with self.lock:
            self._closed = True
            self.lock.notify_all()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        with self.lock:
            while not self._closed:
                if (left := self._send_due()) != 0.0:
                    self.lock.wait(left)

    def _send_due(self) -> float | None:
        """Send the next setpoint if it is due; return when to look again [s], None: if notified."""
        schedule, following = self._playing, self._next
        if schedule is None:
            return None
        if following is not None and schedule.stamp(self._index) >= following.start:
            self._playing, self._next, self._index = following, None, 0
            return 0.0
        early = schedule.stamp(self._index) - self._lead - self._now()
        if early > 0:
            return early * 1e-9
        obstacle = self._obstacle()
        if obstacle is not None:
            self.abandon(obstacle)
            return None
        if self._index == 0:
            # The motions that this one takes over from were not played to their ends.
            before = itertools.takewhile(lambda s: s is not schedule, self._open)
            left = [s for s in before if s.stamp(s.count - 1) >= schedule.start]
            self._end(left, "replaced", f"by plan {schedule.plan_id}")
        self._send(schedule, self._index)
        self._index += 1
        if self._index == schedule.count:
            self._playing, self._next, self._index = self._next, None, 0
        return 0.0

    def _end(self, over: list[Schedule], outcome: str, reason: str) -> None:
        self._open = [schedule for schedule in self._open if schedule not in over]
        for schedule in over:
            self._ended(schedule, outcome, reason)
