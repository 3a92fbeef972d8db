"""The driver without ROS: state machine, protocol and telemetry behind one lock.

The port's thread calls the methods of `pressure_driver.link.LinkClient`; everybody else calls
`arm`, `vent`, `offer` and `snapshot`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from pressure_driver.admission import Origin
from pressure_driver.protocols.base import (
    BoardIdentity,
    BoardReport,
    BoardReset,
    BoardText,
    Echo,
    Event,
    HostProtocol,
    Telemetry,
)
from pressure_driver.safety import LIVE, Mode, SafetyLimits, SafetyMachine
from pressure_driver.schedule import Counters, ScheduleLimits, Setpoint, SetpointSchedule, Verdict
from pressure_driver.watch.board import BoardWatch
from pressure_driver.watch.following import chamber_gauge
from pressure_driver.watch.limits import MonitorLimits
from pressure_driver.watch.monitor import TelemetryMonitor
from pressure_driver.watch.probe import SteadyProbe
from pressure_driver.watch.texts import LogAllowance

STANDARD_ATMOSPHERE = 101_325.0
"""[Pa] on the wire until the room's has been measured; only vent commands are sent before."""

LARGEST_CLOCK_STEP = 0.3
"""[s] between two ticks, above slewing and late wakes, that means the wall clock was set."""


@dataclass(frozen=True)
class CoreSettings:
    """Everything that makes one driver."""

    schedule: ScheduleLimits = field(default_factory=ScheduleLimits)
    monitor: MonitorLimits = field(default_factory=MonitorLimits)
    safety: SafetyLimits = field(default_factory=SafetyLimits)
    period: int = 50_000_000
    """[ns] of the ticks."""
    interpolate: bool = False
    atmosphere: float = 0.0
    """[Pa] absolute; 0 to measure it."""
    command_validity: float = 0.25
    """[s] after which a board with a watchdog vents by itself."""


@dataclass(frozen=True)
class Snapshot:
    """The driver at one tick; see `der_msgs/PressureState` for the meaning."""

    tick: int
    mode: Mode
    faults: tuple[str, ...]
    setpoint: Setpoint | None
    commanded_differential: tuple[float, ...]
    commanded_chamber: tuple[float, ...]
    measured_differential: tuple[float, ...]
    measured_chamber: tuple[float, ...]
    valve_opening: tuple[float, ...]
    supply_pressure: float
    telemetry_age: float
    round_trip: float
    counters: Counters


class DriverCore:
    """Decides what the board is told, and keeps what it says.

    Args:
        protocol: the driver's end of the board's language.
        settings: limits and times.
        steady: returns the steady clock in s.
        notify: is called after each tick, from the port's thread.
        log: takes a sentence for the log and whether it is a warning.
    """

    def __init__(
        self,
        protocol: HostProtocol,
        settings: CoreSettings,
        steady: Callable[[], float] = time.monotonic,
        notify: Callable[[], None] = lambda: None,
        log: Callable[[str, bool], None] = lambda *_: None,
    ) -> None:
        self.protocol = protocol
        protocol.assumed_atmosphere = settings.atmosphere or STANDARD_ATMOSPHERE
        self.settings = settings
        self._steady = steady
        self._notify = notify
        self._log = log
        self._lock = threading.RLock()
        pressure_limit = settings.schedule.pressure_limit
        self._schedule = SetpointSchedule(settings.schedule, settings.period, settings.interpolate)
        self._monitor = TelemetryMonitor(
            protocol.chamber_count, settings.monitor, settings.atmosphere, protocol.reports_supply
        )
        # A board that echoes its commands needs no other sign that it hears.
        probe = None if protocol.echoes else SteadyProbe(settings.monitor, pressure_limit)
        self._machine = SafetyMachine(self._schedule, self._monitor, settings.safety, probe)
        self._board = BoardWatch(protocol, pressure_limit, settings.monitor.vented_tolerance)
        self._last_tick = 0
        self._last_mode = Mode.DISARMED
        self._pending_number: int | None = None
        self._board_log = LogAllowance()
        self._limited_noted = 0
        self._was_limited = False
        self._start_noted = False
        self.venting = True
        """Whether the bytes of the last tick were the vent command."""
        self._clock_offset = 0.0
        self.last_text = ""
        """What the board has said last in plain words."""

    # ------------------------------------------------------------------ from any thread

    def arm(self) -> tuple[bool, str]:
        """Allow pressure; returns whether, and a sentence."""
        with self._lock:
            now = self._steady()
            was_live = self._machine.mode in LIVE
            result = self._machine.arm(now)
            if result[0] and not was_live:
                # What the board did meanwhile by itself must not be what it goes on with.
                self.protocol.doubt()
                self._board.greet_now(now)
            self._note_mode()
            return result

    def vent(self) -> tuple[bool, str]:
        """Open all chambers and refuse setpoints until armed again."""
        with self._lock:
            result = self._machine.vent(self._steady())
            self._note_mode()
            return result

    def offer(self, setpoint: Setpoint, wall: int, origin: Origin | None = None) -> Verdict:
        """Take a setpoint.

        Args:
            setpoint: stamp 0 means now.
            wall: [ns] wall clock.
            origin: where it came from; None inside one program.
        """
        with self._lock:
            return self._machine.offer(setpoint, wall, self._steady(), origin)

    def obstacles(self) -> list[str]:
        """Return what forbids arming now."""
        with self._lock:
            return self._machine.obstacles(self._steady())

    @property
    def atmosphere(self) -> float:
        """[Pa] measured or given; NaN before."""
        return self._monitor.atmosphere

    @property
    def identity(self) -> BoardIdentity | None:
        """How the board has introduced itself; None before, and where the protocol has no such."""
        return self._board.identity

    @property
    def last_refusal(self) -> str:
        """Why the last setpoint that was not accepted was not."""
        return self._schedule.reason

    @property
    def foreign_setpoints(self) -> int:
        """Setpoints that were refused since another publisher was being played."""
        return self._machine.sources.refused

    @property
    def limited_ticks(self) -> int:
        """Ticks at which the slew limit held the output back."""
        return self._machine.limited_ticks

    @property
    def unlogged_texts(self) -> int:
        """Texts of the board that came too fast for the log."""
        return self._board_log.withheld

    @property
    def waiting(self) -> int:
        """Setpoints that have not come into force yet."""
        return self._schedule.waiting

    def snapshot(self) -> Snapshot:
        """Return the driver as it is now."""
        with self._lock:
            monitor, machine = self._monitor, self._machine
            gauge = monitor.gauge
            base = monitor.atmosphere if monitor.rest_known() else STANDARD_ATMOSPHERE
            return Snapshot(
                tick=self._last_tick,
                mode=machine.mode,
                faults=tuple(machine.faults),
                setpoint=self._schedule.current,
                commanded_differential=machine.differential,
                commanded_chamber=tuple((base + chamber_gauge(machine.differential)).tolist()),
                measured_differential=tuple((gauge[0::2] - gauge[1::2]).tolist()),
                measured_chamber=tuple(monitor.chamber_pressure.tolist()),
                valve_opening=tuple(monitor.valve_opening.tolist()),
                supply_pressure=monitor.supply_pressure,
                telemetry_age=monitor.telemetry_age(self._steady()),
                round_trip=self._board.round_trip,
                counters=Counters(**vars(self._schedule.counters)),
            )

    # ------------------------------------------------------------- from the port's thread

    def opening(self) -> bytes:
        """Greet and vent: whatever the board held before, it lets go of now."""
        with self._lock:
            self.protocol.reset()
            self._monitor.forget()
            self._machine.link_fault = ""
            self._board.opened(self._steady())
            self._watch_board(self._steady())
            return self.protocol.start() + self._vent_bytes()

    def tick(self, instant: int) -> bytes:
        """Return the command of this tick."""
        with self._lock:
            now = self._steady()
            self._watch_wall_clock(instant, now)
            self._last_tick = instant
            self._watch_board(now)
            action = self._machine.tick(instant, now)
            self.venting = action.dump or bool(self.protocol.unsettled)
            if self.venting:
                self._machine.command_nothing()
                return self._board.greeting(now) + self._vent_bytes()
            data, self._pending_number = self.protocol.setpoint(
                action.differential, self._wire_atmosphere(), self.settings.command_validity
            )
            return data

    def _watch_wall_clock(self, instant: int, now: float) -> None:
        """Drop the schedule if the wall clock was set: its stamps do not mean what they meant."""
        offset = instant * 1e-9 - now
        step = offset - self._clock_offset
        self._clock_offset = offset
        if self._last_tick and abs(step) > LARGEST_CLOCK_STEP:
            self._log(f"the clock was set by {step:.1f} s: waiting setpoints are dropped", True)
            self._schedule.clear()
            self._schedule.forget_ticks()

    def sent(self, instant: int) -> None:  # noqa: ARG002 - the protocol of the link
        """Do what can wait until the bytes are out."""
        with self._lock:
            now = self._steady()
            self._monitor.command(self._machine.differential, now)
            self._board.has_sent(self._pending_number, now)
            self._note_mode()
            self._note_limit()
            self._note_start()
        self._notify()

    def received(self, data: bytes) -> None:
        """Decode what the board has sent."""
        with self._lock:
            now = self._steady()
            rejected = self.protocol.rejected
            events = self.protocol.decode(data)
            for event in events:
                self._take(event, now)
            readings = sum(isinstance(event, Telemetry) for event in events)
            self._monitor.note_quality(readings, self.protocol.rejected - rejected, now)
            self._watch_board(now)

    def lost(self, reason: str) -> None:
        """The port is gone: everything that was armed faults."""
        with self._lock:
            self._machine.link_fault = reason
            self._monitor.forget()
            self._note_mode()

    def farewell(self) -> bytes:
        """Return the vent command."""
        with self._lock:
            return self._vent_bytes()

    def emergency(self) -> bytes:
        """Return the vent command for the guardian, complete after any half-sent bytes."""
        with self._lock:
            return self.protocol.separator + self.protocol.vent(self._wire_atmosphere())[0]

    def failed(self, reason: str) -> None:
        """Go to FAULT for a reason beside port and board."""
        with self._lock:
            self._machine.fail(reason)
            self._note_mode()

    @property
    def separator(self) -> bytes:
        """What ends half-sent bytes."""
        return self.protocol.separator

    def _watch_board(self, now: float) -> None:
        """Find out whether the board is set up, reports, and takes commands."""
        if self._monitor.telemetry_faults(now):
            self.protocol.doubt()
        if (silence := self._board.silence(now)) and self._machine.mode in LIVE:
            self._machine.fail(silence)
        self._machine.board_obstacle = self._board.obstacle(now)

    def _take_reset(self, reset: BoardReset, now: float) -> None:
        """Set the board up anew; what was being played must not be played on."""
        self._log(f"the board has been reset: {reset.sign}", True)
        self._board.has_reset(self._monitor.chamber_pressure, now)
        self._monitor.forget()
        if self._machine.mode in LIVE:
            self._machine.fail(f"the board has been reset: {reset.sign}")

    def _wire_atmosphere(self) -> float:
        return self._monitor.atmosphere if self._monitor.rest_known() else STANDARD_ATMOSPHERE

    def _vent_bytes(self) -> bytes:
        data, self._pending_number = self.protocol.vent(self._wire_atmosphere())
        return data

    def _take(self, event: Event, now: float) -> None:
        if isinstance(event, Telemetry):
            # Rest pressures are measured only where nothing has been asked of the chambers.
            resting = self._machine.mode in (Mode.DISARMED, Mode.FAULT)
            self._monitor.receive(event, now, resting)
            if event.chamber_pressure is not None:
                self._board.reports(self._monitor.chamber_pressure)
                self._machine.hear(now)
        elif isinstance(event, Echo):
            self._board.take_echo(event, now)
        elif isinstance(event, BoardReport):
            self._log_board(event.text, True, now)
            if event.fatal:
                self._machine.fail(f"board reports {event.text}")
        elif isinstance(event, BoardReset):
            self._take_reset(event, now)
        elif isinstance(event, BoardIdentity):
            self._board.check_identity(event)
        elif isinstance(event, BoardText):
            self.last_text = event.text
            self._board.says_words()
            self._log_board(event.text, False, now)

    def _log_board(self, text: str, warning: bool, now: float) -> None:
        """Log what the board says, unless it talks too much: a log must never hold up a vent."""
        if self._board_log.allows(now):
            self._log(f"board: {text}", warning)
        elif self._board_log.withheld == 1:
            self._log("the board sends text faster than it is logged: the rest is counted", True)

    def _note_limit(self) -> None:
        """Say when the slew limit begins to hold the output back."""
        limited = self._machine.limited_ticks
        if limited > self._limited_noted and not self._was_limited:
            self._log("the slew limit holds the output back: it follows the setpoints late", True)
        self._was_limited = limited > self._limited_noted
        self._limited_noted = limited

    def _note_start(self) -> None:
        """Warn once of a board that has started with pressure in its chambers."""
        warning = self._board.started_under_pressure(self._monitor.rest_pressure)
        if warning and not self._start_noted:
            self._log(warning, True)
        self._start_noted = bool(warning)

    def _note_mode(self) -> None:
        mode = self._machine.mode
        if mode is not self._last_mode:
            reasons = ": " + "; ".join(self._machine.faults) if mode is Mode.FAULT else ""
            self._log(f"{self._last_mode.name} -> {mode.name}{reasons}", mode is Mode.FAULT)
            self._last_mode = mode
