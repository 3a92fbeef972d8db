"""The driver's state machine: when the limb may be pressurised, and what ends it.

::

    DISARMED --arm--> ARMED --setpoint due--> TRACKING --setpoints stop--> HOLDING --hold time--+
        ^               ^                        ^  ^                          |               |
        |               |                        |  +------setpoint due--------+               |
        |               |                        +---------setpoint due------- VENTING (ramp) <-+
        |               +-------------------------------at zero differential------+
        |
        +--chambers are down-- VENTING (latched) <--vent-- any state but FAULT and DISARMED

    any state --something failed--> FAULT (vented) --arm, once the cause is gone--> ARMED

Everything here is plain Python with the time passed in, and is called under one lock.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from pressure_driver.monitor import Monitor
from pressure_driver.schedule import NANOSECONDS, Sample, Schedule, Setpoint, Verdict


class Mode(IntEnum):
    """States, with the numbers of `der_msgs/PressureState`."""

    DISARMED = 0
    ARMED = 1
    TRACKING = 2
    HOLDING = 3
    VENTING = 4
    FAULT = 5


@dataclass(frozen=True)
class SafetyLimits:
    """When the driver gives up on a stream of setpoints, and how it lets the air out."""

    setpoint_timeout: float = 0.2
    """[s] after a setpoint's stamp without a next one: the stream has stopped."""
    hold_time: float = 1.0
    """[s] the last pressures are kept then."""
    vent_rate: float = 10_000.0
    """[Pa/s] of the ramp to zero differential."""
    vent_timeout: float = 10.0
    """[s] a commanded vent may take before it is a fault."""


@dataclass(frozen=True)
class Action:
    """What is to be sent at one tick."""

    differential: tuple[float, ...]
    """(M,) [Pa]."""
    dump: bool
    """Send the vent command instead."""


LIVE = (Mode.ARMED, Mode.TRACKING, Mode.HOLDING, Mode.VENTING)


class SafetyMachine:
    """Turns setpoints, telemetry and requests into what the board is told.

    Args:
        schedule: of timed setpoints.
        monitor: of the board's telemetry.
        limits: of the state machine.
    """

    def __init__(self, schedule: Schedule, monitor: Monitor, limits: SafetyLimits) -> None:
        self.schedule = schedule
        self.monitor = monitor
        self.limits = limits
        self.mode = Mode.DISARMED
        self.faults: list[str] = []
        """Why the mode is FAULT, worst first."""
        self.link_fault: str = "the serial port is not open"
        """What is wrong with the line; empty while it works."""
        self.board_obstacle: str = ""
        """What is wrong with the board itself; empty if nothing is."""
        self._zero = (0.0,) * schedule.limits.segment_count
        self.differential = self._zero
        """(M,) [Pa] commanded at the last tick."""
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
        if self.mode in LIVE and not self._latched:
            return True, f"already armed ({self.mode.name})"
        obstacles = self.obstacles(now)
        if obstacles:
            return False, "not armed: " + "; ".join(obstacles)
        self.faults = []
        self._latched = False
        self.schedule.clear()
        self.monitor.reset_following(now)
        self.differential = self._zero
        self._enter(Mode.ARMED)
        return True, "armed"

    def obstacles(self, now: float) -> list[str]:
        """Return what forbids arming now."""
        monitor = self.monitor
        if self.link_fault:
            return [self.link_fault]
        if self.board_obstacle:
            return [self.board_obstacle]
        found = monitor.telemetry_faults(now)
        if found:
            return found
        found = monitor.overpressure_faults() + monitor.supply_faults(now)
        if not monitor.rest_known():
            found.append(
                "the rest pressures are not measured yet: chambers must be vented and steady"
            )
        elif not monitor.vented():
            found.append("the chambers are not vented yet: " + monitor.describe_gauge())
        return found

    def vent(self, now: float) -> tuple[bool, str]:
        """Open everything at once and stay so until armed again. Works in every state."""
        self.schedule.clear()
        self.differential = self._zero
        if self.mode is Mode.FAULT:
            return True, "venting; the fault stays until it is armed again"
        if self.mode is Mode.DISARMED:
            return True, "venting; it was not armed"
        self._latched = True
        self._vent_since = now
        self._enter(Mode.VENTING)
        return True, "venting; call arm to go on"

    def offer(self, setpoint: Setpoint, wall: int) -> Verdict:
        """Take a setpoint.

        Args:
            setpoint: stamp 0 means now.
            wall: [ns] wall clock.
        """
        if self.mode not in LIVE or self._latched:
            return self.schedule.refuse(f"setpoints are refused while {self.mode.name}: arm first")
        return self.schedule.offer(setpoint, wall, self.differential)

    def fail(self, reason: str) -> None:
        """Go to FAULT for a reason from outside (the line, the board's own report)."""
        self._fault([reason])

    # ------------------------------------------------------------------------------- ticks

    def tick(self, tick: int, now: float) -> Action:
        """Advance to one tick and say what the board is to be told.

        Args:
            tick: [ns] wall time of the tick, on the grid.
            now: [s] steady clock.
        """
        sample = self.schedule.sample(tick)
        self._look_for_faults(now)
        if self.mode in (Mode.DISARMED, Mode.FAULT):
            self.differential = self._zero
            return Action(self._zero, dump=True)
        if self._latched:
            return self._vent_latched(now)
        self._follow(sample, now)
        return Action(self.differential, dump=self.mode is Mode.ARMED)

    def _follow(self, sample: Sample | None, now: float) -> None:
        """Move between ARMED, TRACKING, HOLDING and VENTING, and set what is commanded.

        How long setpoints have been missing is taken on the steady clock: a wall clock that is set
        back must not keep a limb under pressure.
        """
        if sample is not None and sample.fresh:
            self.differential = sample.differential
            self._fresh_at = now
            self._enter(Mode.TRACKING)
            return
        silence = now - self._fresh_at
        if self.mode is Mode.TRACKING and silence > self.limits.setpoint_timeout:
            self._enter(Mode.HOLDING)
        if self.mode is Mode.HOLDING and (
            silence > self.limits.setpoint_timeout + self.limits.hold_time
        ):
            self._enter(Mode.VENTING)
        if self.mode is Mode.VENTING:
            self._ramp_down()

    def _ramp_down(self) -> None:
        """One step of the ramp; all segments arrive together, so that the limb keeps its shape."""
        largest = max(abs(value) for value in self.differential)
        step = self.limits.vent_rate * self.schedule.period / NANOSECONDS
        if largest <= step:
            self.differential = self._zero
            if not self.schedule.waiting:
                self.schedule.clear()
            self._enter(Mode.ARMED)
        else:
            share = 1.0 - step / largest
            self.differential = tuple(value * share for value in self.differential)

    def _vent_latched(self, now: float) -> Action:
        self.differential = self._zero
        if self.monitor.vented():
            self._latched = False
            self._enter(Mode.DISARMED)
        elif now - self._vent_since > self.limits.vent_timeout:
            self._fault(
                [
                    f"not vented {now - self._vent_since:.1f} s after `vent`: "
                    + self.monitor.describe_gauge()
                ]
            )
        return Action(self._zero, dump=True)

    def _look_for_faults(self, now: float) -> None:
        monitor = self.monitor
        found = monitor.overpressure_faults() + monitor.following_faults(now)
        if self.mode in LIVE:
            # Without a port there is no telemetry either: one cause, one reason.
            silent = [self.link_fault] if self.link_fault else monitor.telemetry_faults(now)
            found += silent + monitor.supply_faults(now)
        if found and self.mode is not Mode.FAULT:
            self._fault(found)

    def _fault(self, reasons: list[str]) -> None:
        self.faults = self.faults + [reason for reason in reasons if reason not in self.faults]
        self._latched = False
        self.differential = self._zero
        self.schedule.clear()
        self._enter(Mode.FAULT)

    def _enter(self, mode: Mode) -> None:
        self.mode = mode
