"""The driver without a port and without ROS: what the board is told, and what it says.

`pressure_driver.board` calls it at every tick and with all that comes, from one thread.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pressure_driver.following import chamber_gauge
from pressure_driver.protocols import (
    STANDARD_ATMOSPHERE,
    BoardFailure,
    BoardIdentity,
    BoardReset,
    BoardText,
    Echo,
    Event,
    HostProtocol,
    Telemetry,
    order_of,
)
from pressure_driver.safety import LIVE, Mode, SafetyMachine
from pressure_driver.schedule import NANOSECONDS, Origin, RunningClock, Setpoint, Verdict
from pressure_driver.telemetry import Condition, TelemetryMonitor

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

LARGEST_CLOCK_STEP = 0.3
"""[s] between two ticks, above slewing and late wakes, that means the wall clock was set."""
MOST_TEXTS = 20
"""Texts of the board that wait to be logged, one a tick; of more, the newest."""
IDENTITY_RETRY = 1.0
"""[s] after which a board that has not introduced or set itself up is greeted again."""
ECHO_TIMEOUT = 1.0
"""[s] without an echo of any command, on boards that echo: the board takes no commands."""


class BoardWatch:
    """What is known about the board beside its pressures: which it is, and whether it answers.

    Args:
        protocol: the driver's end of the board's language.
        settings: what the board must reach.
    """

    def __init__(self, protocol: HostProtocol, settings: Settings) -> None:
        self.identity: BoardIdentity | None = None
        self.round_trip = float("nan")
        """[s] from the last command that was echoed to its echo."""
        self._protocol = protocol
        self._settings = settings
        self._unanswered: deque[tuple[int | None, float]] = deque(maxlen=256)
        self._greeted_at = 0.0

    def opened(self, now: float) -> None:
        """The port has been opened, and the board greeted."""
        self._unanswered.clear()
        self._greeted_at = now

    def greet_now(self, now: float) -> None:
        """Have what the board does not confirm asked at the next tick (steady clock [s])."""
        self._greeted_at = now - IDENTITY_RETRY

    def greeting(self, now: float) -> bytes:
        """Return the greeting again while it has not been answered; a board may boot slowly."""
        if not self._protocol.unsettled or now - self._greeted_at < IDENTITY_RETRY:
            return b""
        self._greeted_at = now
        return self._protocol.start()

    def has_sent(self, number: int | None, now: float) -> None:
        """A command with this number, if its protocol has numbers, has gone out."""
        self._unanswered.append((number, now))

    def take_echo(self, echo: Echo, now: float) -> None:
        """Measure the round trip; an echo without a number is that of the newest command."""
        numbers = [number for number, _ in self._unanswered]
        # A status that left the board before the newest command came echoes an older one: the
        # newest goes on waiting for its own.
        if echo.sequence not in numbers:
            return
        answered = len(numbers) if echo.sequence is None else numbers.index(echo.sequence) + 1
        for _ in range(answered):
            self.round_trip = now - self._unanswered.popleft()[1]

    def conditions(self, now: float) -> Iterator[Condition]:
        """Say what about the board forbids arming (steady clock [s])."""
        protocol, identity = self._protocol, self.identity
        wanted = self._settings.pressure_limit
        reach = min(protocol.reach, identity.largest_pressure if identity else wanted)
        problem = protocol.unsettled
        if identity and identity.chamber_count != protocol.chamber_count:
            problem = (
                f"the board has {identity.chamber_count} chambers, the driver expects "
                f"{protocol.chamber_count}: set the parameter 'segment_count'"
            )
        elif reach < wanted:
            problem = f"the board reaches {reach:.0f} Pa: lower 'pressure_limit' ({wanted:.0f} Pa)"
        if problem:
            yield Condition(problem, lasting=False)
        waits_since = self._unanswered[0][1] if self._unanswered else now
        if protocol.echoes and now - waits_since > ECHO_TIMEOUT:
            yield Condition(f"the board has not answered a command for {ECHO_TIMEOUT:g} s")


class DriverCore:
    """Decides what the board is told, and keeps what it says.

    Args:
        protocol: the driver's end of the board's language.
        settings: limits and times.
        steady: returns the steady clock in s.
        log: takes a sentence for the log and whether it is a warning.
    """

    def __init__(
        self,
        protocol: HostProtocol,
        settings: Settings,
        steady: Callable[[], float] = time.monotonic,
        log: Callable[[str, bool], None] = lambda *_: None,
    ) -> None:
        self.protocol = protocol
        protocol.assumed_atmosphere = settings.atmosphere or STANDARD_ATMOSPHERE
        self.venting = True
        """Whether the bytes of the last tick were the vent command."""
        self.last_text = ""
        """What the board has said last in plain words."""
        self.clock = RunningClock(2.0 / settings.rate, steady)
        """Counts the seconds of every patience."""
        protocol.clock, protocol.room = self.clock, self._wire_atmosphere
        self.monitor = TelemetryMonitor(protocol, settings)
        self.machine = SafetyMachine(settings, self.monitor, self._conditions)
        self.board = BoardWatch(protocol, settings)
        self._valves = order_of(settings.wiring, protocol.chamber_count)
        self._log = log
        self._link_fault = "the serial port is not open"
        self._texts: deque[str] = deque(maxlen=MOST_TEXTS)
        self._last_tick = 0
        self._last_mode = Mode.DISARMED
        self._clock_offset = 0.0

    def _conditions(self, now: float) -> Iterator[Condition]:
        """Say everything that is wrong; without a port there is no telemetry: one cause."""
        if self._link_fault:
            yield Condition(self._link_fault)
            return
        yield from self.board.conditions(now)
        yield from self.monitor.conditions(now)

    # -------------------------------------------------------------------------- requests

    def arm(self) -> tuple[bool, str]:
        """Allow pressure; returns whether, and a sentence."""
        now = self.clock()
        was_live = self.machine.mode in LIVE
        result = self.machine.arm(now)
        if result[0] and not was_live:
            # What the board did meanwhile by itself must not be what it goes on with.
            self.protocol.doubt()
            self.board.greet_now(now)
        self._note_mode()
        return result

    def vent(self) -> tuple[bool, str]:
        """Open all chambers and refuse setpoints until armed again; returns whether it is heard."""
        now = self.clock()
        result = self.machine.vent(now)
        self._note_mode()
        if unheard := self._link_fault or self.monitor.silence(now):
            said = "the chambers may keep their pressures, close the valve at the air supply"
            return False, f"{said}: {unheard}"
        return result

    def offer(self, setpoint: Setpoint, wall: int, origin: Origin | None = None) -> Verdict:
        """Take a setpoint.

        Args:
            setpoint: stamp 0 means now.
            wall: [ns] wall clock.
            origin: where it came from; None inside one program.
        """
        return self.machine.offer(setpoint, wall, self.clock(), origin)

    def obstacles(self) -> list[str]:
        """Return what forbids arming now."""
        return self.machine.obstacles(self.clock())

    # ----------------------------------------------------------------------------- state

    def highest_pressure(self) -> float:
        """Return the highest gauge pressure [Pa] that was measured; 0 where it counts as none."""
        pressure = max(self.monitor.gauge)
        return pressure if pressure > self.monitor.vented_tolerance else 0.0

    def state(self) -> dict[str, Any]:
        """Return the driver at this tick, by the names of `der_msgs/PressureState`, and more."""
        monitor, machine = self.monitor, self.machine
        gauge, base = monitor.gauge, self._wire_atmosphere()
        current = machine.schedule.current or Setpoint(0, ())
        counts = machine.schedule.counts
        return {
            "tick": self._last_tick,
            "setpoint_stamp": current.stamp,
            "mode": machine.mode,
            "faults": machine.faults,
            "plan_id": current.plan_id,
            "index": current.index,
            "commanded_differential": list(machine.differential),
            "measured_differential": [a - b for a, b in zip(gauge[0::2], gauge[1::2], strict=True)],
            "commanded_chamber": [base + value for value in chamber_gauge(machine.differential)],
            "measured_chamber": list(monitor.chamber_pressure),
            "valve_opening": monitor.valve_opening,
            "supply_pressure": monitor.supply_pressure,
            "telemetry_age": monitor.telemetry_age(self.clock()),
            "round_trip": self.board.round_trip,
            **{
                f"setpoints_{name}": counts[name]
                for name in ("accepted", "executed", "late", "duplicate", "refused", "superseded")
            },
            "setpoints_waiting": machine.schedule.waiting,
            "setpoints_of_other_publishers": machine.publishers.refused,
            "last_refusal": machine.schedule.reason,
            "operators": str(machine.leases),
            "lost_operator": machine.lost_operator,
            "obstacles_to_arming": self.obstacles(),
            "board": self.board.identity.firmware if self.board.identity else self.last_text,
            "atmosphere_pa": monitor.rest.mean,
            "pressure_limit_pa": machine.schedule.settings.pressure_limit,
            "damaged_frames": self.protocol.rejected,
            "last_damaged_line": self.protocol.last_damaged,
            "ticks_held_back_by_slew_limit": machine.limited_ticks,
        }

    # ----------------------------------------------------------------------- to the board

    def opening(self) -> bytes:
        """Greet and vent: whatever the board held before, it lets go of now."""
        self.protocol.reset()
        self.monitor.forget()
        self._link_fault = ""
        self.board.opened(self.clock())
        return self.protocol.start() + self.protocol.vent()

    def tick(self, instant: int) -> bytes:
        """Return the command of the tick at this wall time [ns]."""
        now = self.clock()
        self._watch_wall_clock(instant)
        self._last_tick = instant
        if self.monitor.silence(now):
            self.protocol.doubt()
        self.venting = self.machine.tick(instant, now) or bool(self.protocol.unsettled)
        if self.venting:
            self.machine.command_nothing()
            return self.board.greeting(now) + self.protocol.vent()
        asked = dict(zip(self._valves, chamber_gauge(self.machine.differential), strict=True))
        return self.protocol.setpoint([asked[valve] for valve in sorted(asked)])

    def sent(self) -> None:
        """Do what can wait until the bytes of the tick are out."""
        now = self.clock()
        self.monitor.command(self.machine.differential, now)
        self.board.has_sent(self.protocol.number, now)
        self._note_mode()
        if self._texts:
            self._log(f"board: {self._texts.popleft()}", False)

    def _wire_atmosphere(self) -> float:
        return self.monitor.rest.mean if self.monitor.rest.known else STANDARD_ATMOSPHERE

    def _watch_wall_clock(self, instant: int) -> None:
        """Drop the schedule if the wall clock was set: its stamps do not mean what they meant."""
        offset = instant / NANOSECONDS - self.clock.steady
        step = offset - self._clock_offset
        self._clock_offset = offset
        if self._last_tick and abs(step) > LARGEST_CLOCK_STEP:
            self._log(f"the clock was set by {step:.1f} s: waiting setpoints are dropped", True)
            self.machine.schedule.clear()
            self.machine.schedule.forget_ticks()

    # --------------------------------------------------------------------- from the board

    def received(self, data: bytes) -> bytes:
        """Decode what the board has sent; return what is to be sent to it at once."""
        now = self.clock()
        rejected = self.protocol.rejected
        events = self.protocol.decode(data)
        for event in events:
            self._serve(event, now)
        readings = sum(isinstance(event, Telemetry) for event in events)
        damaged = self.protocol.rejected - rejected
        self.monitor.count_lines(readings, damaged, bool(events), now)
        return self.protocol.follow_up()

    def lost(self, reason: str) -> None:
        """The port is gone: everything that was armed faults."""
        self._link_fault = reason
        self.monitor.forget()

    def _serve(self, event: Event, now: float) -> None:
        if isinstance(event, Telemetry):
            event = replace(
                event,
                chamber_pressure=self._of_chambers(event.chamber_pressure),
                valve_opening=self._of_chambers(event.valve_opening),
            )
            # Rest pressures are measured only where nothing has been asked of the chambers.
            self.monitor.receive(event, now, self.machine.mode in (Mode.DISARMED, Mode.FAULT))
        elif isinstance(event, Echo):
            self.board.take_echo(event, now)
        elif isinstance(event, BoardFailure):
            self._texts.append(event.text)
            self.machine.fail(f"board reports {event.text}")
        elif isinstance(event, BoardReset):
            self._set_up_anew(event, now)
        elif isinstance(event, BoardIdentity):
            self.board.identity = event
        elif isinstance(event, BoardText):
            self.last_text = event.text
            self._texts.append(event.text)

    def _of_chambers(self, told: tuple[float, ...] | None) -> tuple[float, ...] | None:
        """Return what a board tells of its valves in the order of the limb's chambers."""
        return told and tuple(told[valve] for valve in self._valves)

    def _set_up_anew(self, reset: BoardReset, now: float) -> None:
        """Greet a board that has been reset; what was being played must not be played on."""
        reason = f"the board has been reset: {reset.sign}"
        self._log(reason, True)
        self.board.greet_now(now)
        self.monitor.forget()
        if self.machine.mode in LIVE:
            self.machine.fail(reason)

    # -------------------------------------------------------------------------- to the log

    def _note_mode(self) -> None:
        mode = self.machine.mode
        if mode is not self._last_mode:
            lost = self.machine.lost_operator
            reasons = f": the operator ({lost}) is lost" if lost else ""
            if mode is Mode.FAULT:
                reasons = ": " + "; ".join(self.machine.faults)
            self._log(f"{self._last_mode.name} -> {mode.name}{reasons}", bool(reasons))
            self._last_mode = mode
