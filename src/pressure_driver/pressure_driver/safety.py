"""The driver's state machine: when the limb may be pressurised, and what ends it.

::

    DISARMED --arm--> ARMED --setpoint due--> TRACKING --setpoints stop--> HOLDING --hold time--+
        ^               ^                        ^  ^                          |               |
        |               |                        |  +------setpoint due--------+               |
        |               |                        +---------setpoint due------- VENTING (ramp) <-+
        |               +-------------------------------at zero differential------+
        |
        |  a lost operator: hold or ramp, then as after vent
        +--chambers are down-- VENTING (latched) <--vent-- any state but FAULT and DISARMED

    any state --something failed--> FAULT (vented) --arm, once the cause is gone--> ARMED

Everything here is plain Python with the time passed in.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import IntEnum
from typing import TYPE_CHECKING

from pressure_driver.schedule import (
    NANOSECONDS,
    Origin,
    PublisherGate,
    Setpoint,
    SetpointSchedule,
    SpentPlans,
    Verdict,
)
from pressure_driver.telemetry import Condition, TelemetryMonitor

if TYPE_CHECKING:
    from pressure_driver.settings import Settings


class Mode(IntEnum):
    """States, with the numbers of `der_msgs/PressureState`."""

    DISARMED = 0
    ARMED = 1
    TRACKING = 2
    HOLDING = 3
    VENTING = 4
    FAULT = 5


MOST_FAULTS = 16
"""Reasons that are kept; more would only be more of the same."""
LIVE = (Mode.ARMED, Mode.TRACKING, Mode.HOLDING, Mode.VENTING)
LONGEST_LEASE = 60.0
"""[s] A longer promise says nothing."""


class OperatorLeases:
    """Who has promised to be heard again soon, because somebody watches the limb there."""

    def __init__(self) -> None:
        self._until: dict[str, float] = {}

    def renew(self, source: str, period: float, now: float) -> str:
        """Take a promise to be heard again within a period [s]; 0 gives it up on purpose.

        Returns:
            Why it is not taken, or nothing.
        """
        if not 0.0 <= period <= LONGEST_LEASE:
            return f"the lease of '{source}' lasts {period:g} s: give 0 to {LONGEST_LEASE:g} s"
        if period == 0.0:
            self._until.pop(source, None)
        else:
            self._until[source] = now + period
        return ""

    def ended(self, now: float) -> list[str]:
        """Return, once, who has not been heard again (steady clock [s])."""
        ended = [source for source, until in self._until.items() if now > until]
        for source in ended:
            del self._until[source]
        return ended

    def __str__(self) -> str:
        return ", ".join(self._until) or "none"


class SafetyMachine:
    """Turns setpoints, telemetry and requests into what the board is told.

    Args:
        settings: limits and times.
        monitor: of the board's telemetry.
        conditions: returns everything that is wrong at a time of the steady clock [s].
    """

    def __init__(
        self,
        settings: Settings,
        monitor: TelemetryMonitor,
        conditions: Callable[[float], Iterable[Condition]],
    ) -> None:
        self.schedule = SetpointSchedule(settings)
        """Of timed setpoints."""
        self.monitor = monitor
        self.mode = Mode.DISARMED
        self.faults: list[str] = []
        """Why the mode is FAULT, worst first."""
        self.publishers = PublisherGate()
        self.leases = OperatorLeases()
        self.lost_operator = ""
        """Whose lease has ended since the last arming: until the next, nothing is taken."""
        self.limited_ticks = 0
        """Ticks at which the output was held back by the slew limit."""
        self._settings = settings
        self._period = self.schedule.period / NANOSECONDS
        self._conditions = conditions
        self._zero = (0.0,) * settings.segment_count
        self.differential = self._zero
        """(M,) [Pa] commanded at the last tick."""
        self._spent = SpentPlans()
        self._target = self._zero
        self._latched = False
        self._vent_since = 0.0
        self._fresh_at = 0.0

    # ----------------------------------------------------------------------------- requests

    def arm(self, now: float) -> tuple[bool, str]:
        """Allow pressure, if nothing speaks against it.

        Args:
            now: [s] steady clock.

        Returns:
            Whether the driver is armed, and a sentence.
        """
        if self.mode in LIVE and not self._latched and not self.lost_operator:
            if self.mode is Mode.ARMED:
                self.publishers.release()
            return True, f"already armed ({self.mode.name})"
        obstacles = self.obstacles(now)
        if obstacles:
            return False, "not armed: " + "; ".join(obstacles)
        self.faults = []
        self._latched, self.lost_operator = False, ""
        self.schedule.clear()
        self.publishers.release()
        self.monitor.restart_following(now)
        self.command_nothing()
        self.mode = Mode.ARMED
        return True, "armed"

    def obstacles(self, now: float) -> list[str]:
        """Return what forbids arming now."""
        return [condition.text for condition in self._conditions(now)]

    def vent(self, now: float) -> tuple[bool, str]:
        """Open everything at once and stay so until armed again. Works in every state."""
        self._drop_plans()
        if self.mode is Mode.FAULT:
            return True, "venting; the fault stays until it is armed again"
        if self.mode is Mode.DISARMED:
            return True, "venting; it was not armed"
        self._latched = True
        self._vent_since = now
        self.mode = Mode.VENTING
        return True, "venting; arm to go on"

    def offer(
        self, setpoint: Setpoint, wall: int, now: float, origin: Origin | None = None
    ) -> Verdict:
        """Take a setpoint.

        Args:
            setpoint: stamp 0 means now.
            wall: [ns] wall clock.
            now: [s] steady clock.
            origin: where it came from; None inside one program.
        """
        plan = setpoint.plan_id
        if self.mode not in LIVE or self._latched or self.lost_operator:
            self._spent.hear(plan, now)
            self._spent.spend()
            lost = f", the operator ({self.lost_operator}) is lost" if self.lost_operator else ""
            reason = f"refused while {self.mode.name}{lost}: arm first"
            return self.schedule.refuse(setpoint, reason)
        reason = self._spent.refuse(plan, now)
        if not reason and origin is not None:
            reason = self.publishers.refuse(origin)
        if reason:
            return self.schedule.refuse(setpoint, reason)
        self._spent.hear(plan, now)
        return self.schedule.offer(setpoint, wall, self.differential)

    def _lose_operator(self, source: str, now: float) -> None:
        """Hold, let down or vent as `on_lost_operator` says, until DISARMED; take nothing more."""
        if self.mode not in LIVE or self._latched:
            return
        self.lost_operator = source
        policy = self._settings.on_lost_operator
        if policy == "vent" or self.mode is Mode.ARMED:
            self.vent(now)
            return
        self._spent.spend()
        self.schedule.clear()
        if policy == "ramp":
            self.mode = Mode.VENTING
        elif self.mode is Mode.TRACKING:
            self.mode = Mode.HOLDING
            self._fresh_at = now - self._settings.setpoint_timeout

    def _drop_plans(self) -> None:
        """Forget every setpoint, and refuse the rest of their plans from now on."""
        self._spent.spend()
        self.schedule.clear()
        self.command_nothing()

    def command_nothing(self) -> None:
        """Note that the vent command goes out: what is commanded next starts from zero."""
        self.differential = self._target = self._zero

    # ------------------------------------------------------------------------------- ticks

    def tick(self, tick: int, now: float) -> bool:
        """Advance to one tick: `differential` is what to command.

        Args:
            tick: [ns] wall time of the tick, on the grid.
            now: [s] steady clock.

        Returns:
            Whether the board is to be told to vent instead.
        """
        if lost := self.leases.ended(now):
            self._lose_operator(", ".join(lost), now)
        due = self.schedule.take(tick)
        self._look_for_faults(now)
        if self.mode in (Mode.DISARMED, Mode.FAULT):
            self.command_nothing()
        elif self._latched:
            self._finish_vent(now)
        else:
            self._follow(due, now)
            return self.mode is Mode.ARMED
        return True

    def _follow(self, due: Setpoint | None, now: float) -> None:
        """Move between ARMED, TRACKING, HOLDING and VENTING, and set what is commanded.

        How long setpoints have been missing is taken on the steady clock: a wall clock that is set
        back must not keep a limb under pressure.
        """
        if due is not None:
            self._target = due.differential
            self._fresh_at = now
            self.mode = Mode.TRACKING
        if self.mode is Mode.TRACKING:
            self._approach_target()
        silence = now - self._fresh_at
        if self.mode is Mode.TRACKING and silence > self._settings.setpoint_timeout:
            self.mode = Mode.HOLDING
        if self.mode is Mode.HOLDING and (
            silence > self._settings.setpoint_timeout + self._settings.hold_time
        ):
            self.mode = Mode.VENTING
        if self.mode is Mode.VENTING:
            self._ramp_down()
        if self.lost_operator and self.mode is Mode.ARMED:
            self.vent(now)

    def _approach_target(self) -> None:
        """Move what is commanded to what is wanted, by no more than the slew limit allows a tick.

        The step is taken from what was commanded last, whatever brought it there.
        """
        # A plan at the limit is not beyond it, whatever its numbers are rounded to.
        step = self._settings.slew_limit * self._period * (1.0 + 1e-9)
        moved = tuple(
            min(max(wanted, last - step), last + step)
            for wanted, last in zip(self._target, self.differential, strict=True)
        )
        if moved != self._target:
            self.limited_ticks += 1
        self.differential = moved

    def _ramp_down(self) -> None:
        """One step of the ramp; all segments arrive together, so that the limb keeps its shape."""
        largest = max(abs(value) for value in self.differential)
        step = self._settings.vent_rate * self._period
        if largest <= step:
            self.command_nothing()
            if not self.schedule.waiting:
                self.schedule.clear()
            self.mode = Mode.ARMED
        else:
            share = 1.0 - step / largest
            self.differential = tuple(value * share for value in self.differential)

    def _finish_vent(self, now: float) -> None:
        self.command_nothing()
        if self.monitor.vented():
            self._latched = False
            self.mode = Mode.DISARMED
        elif now - self._vent_since > self._settings.vent_timeout:
            gauge = self.monitor.describe_gauge()
            self.fail(f"not vented within {self._settings.vent_timeout:g} s of `vent`: {gauge}")

    def _look_for_faults(self, now: float) -> None:
        found = list(self.monitor.following_faults(now))
        found += [
            condition.text
            for condition in self._conditions(now)
            if condition.always or (condition.lasting and self.mode is not Mode.DISARMED)
        ]
        if found:
            self.fail(*found)

    def fail(self, *reasons: str) -> None:
        """Go to FAULT and vent.

        A reason that differs from one already known only in its numbers is not added.
        """
        known = {_subject(reason) for reason in self.faults}
        for reason in reasons:
            if _subject(reason) not in known and len(self.faults) < MOST_FAULTS:
                known.add(_subject(reason))
                self.faults = [*self.faults, reason]
        self._latched = False
        self._drop_plans()
        self.mode = Mode.FAULT


def _subject(reason: str) -> str:
    """Return what a fault is about: its text up to the colon, behind which numbers stand."""
    return reason.partition(":")[0]
