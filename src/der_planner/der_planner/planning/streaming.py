"""When each setpoint is sent: a schedule on the absolute 50 ms grid of ROS time, and its player.

The player is plain Python with an injected clock and an injected sender; the node gives it ROS
time and publishers. It sends every setpoint a fixed lead before its stamp, in order, from a thread
of its own, so that planning in the background does not make it late.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass

from der_planner.model import CONTROL_PERIOD
from der_planner.planning.plan_file import Plan
from der_planner.planning.timing import Start

GRID = round(CONTROL_PERIOD * 1e9)
"""Setpoints are stamped on multiples of this [ns]."""


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
        before = self.plan.differential_pressure[index - 1]
        return Start(angles, rate, acceleration, before)

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
    earliest = max(now + lead, wanted)
    return -(-earliest // GRID) * GRID


class Player:
    """Sends the setpoints of a schedule, each ``lead`` before its stamp.

    Args:
        now: returns the present time [ns].
        send: called with schedule and index for every setpoint, in order, from the player's thread.
        lead: [ns].
    """

    def __init__(
        self,
        now: Callable[[], int],
        send: Callable[[Schedule, int], None],
        lead: int,
    ) -> None:
        self._now = now
        self._send = send
        self.lead = lead
        self._wake = threading.Condition()
        self._schedule: Schedule | None = None
        self._next: Schedule | None = None
        self._index = 0
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="setpoints", daemon=True)
        self._thread.start()

    def play(self, schedule: Schedule) -> None:
        """Play a schedule; one that is being played goes on until the new one's first stamp."""
        with self._wake:
            if self._schedule is None:
                self._schedule, self._index = schedule, 0
            else:
                self._next = schedule
            self._wake.notify_all()

    def stop(self) -> bool:
        """Send nothing more; tell whether something was being played."""
        with self._wake:
            was_playing = self._schedule is not None
            self._schedule = self._next = None
            self._wake.notify_all()
        return was_playing

    @property
    def position(self) -> tuple[Schedule, int] | None:
        """The schedule in force and the index of the next setpoint, or None."""
        with self._wake:
            return None if self._schedule is None else (self._schedule, self._index)

    def close(self) -> None:
        """End the thread."""
        with self._wake:
            self._closed = True
            self._wake.notify_all()
        self._thread.join(timeout=2.0)

    def _run(self) -> None:
        while True:
            with self._wake:
                if self._closed:
                    return
                self._take_over()
                schedule, index = self._schedule, self._index
                if schedule is None:
                    self._wake.wait()
                    continue
                wait = schedule.stamp(index) - self.lead - self._now()
                if wait > 0:
                    self._wake.wait(wait * 1e-9)
                    continue
                self._index += 1
                if self._index >= schedule.count:
                    self._schedule, self._index = None, 0
            self._send(schedule, index)

    def _take_over(self) -> None:
        """Switch to the waiting schedule once the present one has reached its first stamp."""
        following = self._next
        if following is None:
            return
        present = self._schedule
        if present is None or present.stamp(self._index) >= following.start:
            self._schedule, self._index, self._next = following, 0, None
