"""The driver without a port and without ROS: what the board is told, and what it says.

`pressure_driver.board` calls it at every tick and with all that comes, from one thread.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from pressure_driver.admission import Origin
from pressure_driver.board_watch import BoardWatch
from pressure_driver.following import chamber_gauge
from pressure_driver.protocols.base import (
    STANDARD_ATMOSPHERE,
    BoardIdentity,
    BoardReport,
    BoardReset,
    BoardText,
    Echo,
    Event,
    HostProtocol,
    Telemetry,
)
from pressure_driver.safety import LIVE, Mode, SafetyMachine
from pressure_driver.schedule import Setpoint, Verdict
from pressure_driver.settings import NANOSECONDS, Settings
from pressure_driver.telemetry import TelemetryMonitor

LARGEST_CLOCK_STEP = 0.3
"""[s] between two ticks, above slewing and late wakes, that means the wall clock was set."""
MOST_TEXTS = 20
"""Texts of the board that wait to be logged, one a tick; more are only counted."""


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
        self.unlogged_texts = 0
        """Texts of the board that came too fast for the log."""
        self.last_text = ""
        """What the board has said last in plain words."""
        self._settings = settings
        self._steady = steady
        self._log = log
        self.monitor = TelemetryMonitor(protocol, settings)
        self.machine = SafetyMachine(settings, self.monitor)
        self.board = BoardWatch(protocol, settings)
        self._texts: deque[str] = deque()
        self._last_tick = 0
        self._last_mode = Mode.DISARMED
        self._pending_number: int | None = None
        self._limited_noted = 0
        self._was_limited = False
        self._start_noted = False
        self._clock_offset = 0.0

    # -------------------------------------------------------------------------- requests

    def arm(self) -> tuple[bool, str]:
        """Allow pressure; returns whether, and a sentence."""
        now = self._steady()
        was_live = self.machine.mode in LIVE
        result = self.machine.arm(now)
        if result[0] and not was_live:
            # What the board did meanwhile by itself must not be what it goes on with.
            self.protocol.doubt()
            self.board.greet_now(now)
        self._note_mode()
        return result

    def vent(self) -> tuple[bool, str]:
        """Open all chambers and refuse setpoints until armed again."""
        result = self.machine.vent(self._steady())
        self._note_mode()
        return result

    def offer(self, setpoint: Setpoint, wall: int, origin: Origin | None = None) -> Verdict:
        """Take a setpoint.

        Args:
            setpoint: stamp 0 means now.
            wall: [ns] wall clock.
            origin: where it came from; None inside one program.
        """
        return self.machine.offer(setpoint, wall, self._steady(), origin)

    def drop_setpoints(self) -> None:
        """Forget those that wait: the stream counts as ended."""
        self.machine.schedule.clear()

    # ----------------------------------------------------------------------------- state

    def highest_pressure(self) -> float:
        """Return the highest gauge pressure [Pa] that was measured; 0 where it counts as none."""
        pressure = max(self.monitor.gauge)
        return pressure if pressure > self._settings.vented_tolerance else 0.0

    def state(self) -> dict[str, Any]:
        """Return the driver at this tick, by the names of `der_msgs/PressureState`."""
        monitor, machine = self.monitor, self.machine
        gauge, base = monitor.gauge, self._wire_atmosphere()
        current = machine.schedule.current or Setpoint(0, ())
        counters = machine.schedule.counters
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
            "telemetry_age": monitor.telemetry_age(self._steady()),
            "round_trip": self.board.round_trip,
            "setpoints_accepted": counters.accepted,
            "setpoints_executed": counters.executed,
            "setpoints_late": counters.late,
            "setpoints_duplicate": counters.duplicate,
            "setpoints_refused": counters.refused,
        }

    def diagnostics(self) -> tuple[str, str, dict[str, Any]]:
        """Return the level, a sentence and the values for the diagnostics."""
        machine, protocol, monitor = self.machine, self.protocol, self.monitor
        obstacles = machine.obstacles(self._steady())
        values = {
            "mode": machine.mode.name,
            "faults": "; ".join(machine.faults) or "none",
            "obstacles_to_arming": "; ".join(obstacles) or "none",
            "last_refusal": machine.schedule.reason or "none",
            "protocol": protocol.name,
            "protocol_weaknesses": "; ".join(protocol.weaknesses) or "none",
            "board": self.board.identity.firmware if self.board.identity else self.last_text,
            "atmosphere_pa": f"{self.monitor.rest.mean:.0f}",
            "telemetry_age_s": f"{monitor.telemetry_age(self._steady()):.3f}",
            "round_trip_s": f"{self.board.round_trip:.4f}",
            "damaged_frames": protocol.rejected,
            "last_damaged_line": protocol.last_damaged or "none",
            "setpoints_waiting": self.machine.schedule.waiting,
            "setpoints_superseded": machine.schedule.counters.superseded,
            "setpoints_missing": machine.schedule.counters.missing,
            "setpoints_of_other_publishers": machine.publishers.refused,
            "ticks_held_back_by_slew_limit": machine.limited_ticks,
            "board_texts_not_logged": self.unlogged_texts,
        }
        if machine.mode is Mode.FAULT:
            return "error", "FAULT: " + "; ".join(machine.faults), values
        if machine.mode is Mode.DISARMED and obstacles:
            level = "error" if monitor.rest.known else "stale"
            return level, "waiting for: " + "; ".join(obstacles), values
        if protocol.weaknesses:
            weakness = f"{machine.mode.name}; {protocol.name}: {protocol.weaknesses[0]}"
            return "warning", weakness, values
        return "ok", machine.mode.name, values

    # ----------------------------------------------------------------------- to the board

    def opening(self) -> bytes:
        """Greet and vent: whatever the board held before, it lets go of now."""
        now = self._steady()
        self.protocol.reset()
        self.monitor.forget()
        self.machine.link_fault = ""
        self.board.opened(now)
        self._watch_board(now)
        return self.protocol.start() + self._vent_bytes()

    def tick(self, instant: int) -> bytes:
        """Return the command of the tick at this wall time [ns]."""
        now = self._steady()
        self._watch_wall_clock(instant, now)
        self._last_tick = instant
        self._watch_board(now)
        vent = self.machine.tick(instant, now)
        self.venting = vent or bool(self.protocol.unsettled)
        if self.venting:
            self.machine.command_nothing()
            return self.board.greeting(now) + self._vent_bytes()
        data, self._pending_number = self.protocol.setpoint(
            self.machine.differential, self._wire_atmosphere(), self._settings.command_validity
        )
        return data

    def sent(self) -> None:
        """Do what can wait until the bytes of the tick are out."""
        now = self._steady()
        self.monitor.command(self.machine.differential, now)
        self.board.has_sent(self._pending_number, now)
        self._note_mode()
        self._note_limit()
        self._note_start()
        if self._texts:
            self._log(f"board: {self._texts.popleft()}", False)

    def emergency(self) -> bytes:
        """Return the vent command, complete after any half-sent bytes."""
        return self.protocol.separator + self._vent_bytes()

    def _wire_atmosphere(self) -> float:
        return self.monitor.rest.mean if self.monitor.rest.known else STANDARD_ATMOSPHERE

    def _vent_bytes(self) -> bytes:
        data, self._pending_number = self.protocol.vent(self._wire_atmosphere())
        return data

    def _watch_wall_clock(self, instant: int, now: float) -> None:
        """Drop the schedule if the wall clock was set: its stamps do not mean what they meant."""
        offset = instant / NANOSECONDS - now
        step = offset - self._clock_offset
        self._clock_offset = offset
        if self._last_tick and abs(step) > LARGEST_CLOCK_STEP:
            self._log(f"the clock was set by {step:.1f} s: waiting setpoints are dropped", True)
            self.machine.schedule.clear()
            self.machine.schedule.forget_ticks()

    # --------------------------------------------------------------------- from the board

    def received(self, data: bytes) -> None:
        """Decode what the board has sent."""
        now = self._steady()
        rejected = self.protocol.rejected
        events = self.protocol.decode(data)
        for event in events:
            self._serve(event, now)
        readings = sum(isinstance(event, Telemetry) for event in events)
        self.monitor.count_lines(readings, self.protocol.rejected - rejected, now)
        self._watch_board(now)

    def lost(self, reason: str) -> None:
        """The port is gone: everything that was armed faults."""
        self.machine.link_fault = reason
        self.monitor.forget()
        self._note_mode()

    def _serve(self, event: Event, now: float) -> None:
        if isinstance(event, Telemetry):
            # Rest pressures are measured only where nothing has been asked of the chambers.
            resting = self.machine.mode in (Mode.DISARMED, Mode.FAULT)
            self.monitor.receive(event, now, resting)
            if event.chamber_pressure is not None:
                self.board.reports(self.monitor.chamber_pressure)
        elif isinstance(event, Echo):
            self.board.take_echo(event, now)
        elif isinstance(event, BoardReport):
            self._log_text(event.text)
            if event.fatal:
                self.machine.fail(f"board reports {event.text}")
        elif isinstance(event, BoardReset):
            self._set_up_anew(event, now)
        elif isinstance(event, BoardIdentity):
            self.board.check_identity(event)
        elif isinstance(event, BoardText):
            self.last_text = event.text
            self.board.says_words()
            self._log_text(event.text)

    def _set_up_anew(self, reset: BoardReset, now: float) -> None:
        """Greet a board that has been reset; what was being played must not be played on."""
        self._log(f"the board has been reset: {reset.sign}", True)
        self.board.has_reset(self.monitor.chamber_pressure, now)
        self.monitor.forget()
        if self.machine.mode in LIVE:
            self.machine.fail(f"the board has been reset: {reset.sign}")

    def _watch_board(self, now: float) -> None:
        """Find out whether the board is set up, reports, and takes commands."""
        if self.monitor.telemetry_faults(now):
            self.protocol.doubt()
        if (silence := self.board.silence(now)) and self.machine.mode in LIVE:
            self.machine.fail(silence)
        self.machine.board_obstacle = self.board.obstacle(now)

    # -------------------------------------------------------------------------- to the log

    def _log_text(self, text: str) -> None:
        """Keep what the board says for the log, unless it talks too much."""
        if len(self._texts) < MOST_TEXTS:
            self._texts.append(text)
            return
        if not self.unlogged_texts:
            self._log("the board sends text faster than it is logged: the rest is counted", True)
        self.unlogged_texts += 1

    def _note_limit(self) -> None:
        """Say when the slew limit begins to hold the output back."""
        limited = self.machine.limited_ticks
        if limited > self._limited_noted and not self._was_limited:
            self._log("the slew limit holds the output back: it follows the setpoints late", True)
        self._was_limited = limited > self._limited_noted
        self._limited_noted = limited

    def _note_start(self) -> None:
        """Warn once of a board that has started with pressure in its chambers."""
        warning = self.board.started_under_pressure(self.monitor.rest.pressure)
        if warning and not self._start_noted:
            self._log(warning, True)
        self._start_noted = bool(warning)

    def _note_mode(self) -> None:
        mode = self.machine.mode
        if mode is not self._last_mode:
            reasons = ": " + "; ".join(self.machine.faults) if mode is Mode.FAULT else ""
            self._log(f"{self._last_mode.name} -> {mode.name}{reasons}", mode is Mode.FAULT)
            self._last_mode = mode
