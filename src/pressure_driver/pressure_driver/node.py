"""The ROS node of the pressure driver: parameters, topics and services around `DriverCore`."""

from __future__ import annotations

import math
import time
from collections import deque

from rcl_interfaces.msg import SetParametersResult
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import QoSSubscriptionMatchedInfo, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray

from der_msgs.msg import PressureSetpoint, PressureState
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import ParameterError
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds
from pressure_driver.admission import Origin
from pressure_driver.core import DriverCore, Snapshot
from pressure_driver.grid import TickGrid
from pressure_driver.guardian_client import GuardianClient
from pressure_driver.link import SerialLink
from pressure_driver.node_parameters import read_parameters
from pressure_driver.node_services import EmergencyServices
from pressure_driver.protocols import host_protocol
from pressure_driver.realtime import prepare_process
from pressure_driver.safety import Mode
from pressure_driver.schedule import Setpoint, Verdict

PASCAL_PER_HECTOPASCAL = 100.0
CMD_U_T = "cmd_u_t"
MOST_LINES = 20
"""Lines of the log that one callback writes: whatever else waits has its turn in between."""


class PressureDriver(Node):
    """Plays `pressure_setpoint`, publishes `pressure_state`, serves `arm` and `vent`."""

    def __init__(self) -> None:
        super().__init__("pressure_driver", namespace=topics.NAMESPACE)
        self.fatal_error = ""
        if self.get_parameter("use_sim_time").value:
            raise ParameterError(
                "parameter 'use_sim_time' is true: the driver moves air in real time; leave it out"
            )
        options = read_parameters(self)
        self._options = options
        protocol = host_protocol(options.protocol, 2 * options.core.schedule.segment_count)
        self._ticks: deque[Snapshot] = deque(maxlen=100)
        self._log_lines: deque[tuple[str, bool]] = deque(maxlen=200)
        self._guard = self.create_guard_condition(self._publish_ticks)
        self._core = DriverCore(
            protocol, options.core, notify=self._on_tick, log=self._log_from_thread
        )
        guarded = options.guardian == "always" or (
            options.guardian == "auto" and not protocol.has_watchdog
        )
        self._guardian = GuardianClient(options.real_time_priority) if guarded else None
        self._link = SerialLink(
            options.port,
            options.baud_rate or protocol.baud_rate,
            TickGrid(options.core.period),
            self._core,
            options.real_time_priority,
            lambda text: self._log_from_thread(text, True),
            self._guardian,
        )
        self._state_publisher = self.create_publisher(
            PressureState, topics.PRESSURE_STATE, qos.STATES
        )
        self._setpoint_topic = self.resolve_topic_name(topics.PRESSURE_SETPOINT)
        self.create_subscription(
            PressureSetpoint,
            topics.PRESSURE_SETPOINT,
            self._on_setpoint,
            qos.SETPOINTS,
            event_callbacks=SubscriptionEventCallbacks(matched=self._on_publishers),
        )
        if options.accept_cmd_u_t:
            self.create_subscription(Float64MultiArray, CMD_U_T, self._on_cmd_u_t, qos.SETPOINTS)
        self._emergency = EmergencyServices(self, self._vent, self._core.arm)
        self._diagnostics = DiagnosticsPublisher(self, self._report, hardware_id=self._link.port)
        self.create_timer(0.2, self._watch_threads, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self.add_on_set_parameters_callback(self._refuse_simulated_time)
        prepare_process(options.real_time_priority)
        self._link.start()
        self._emergency.start()
        self.get_logger().info(
            f"{protocol.name} board on {self._link.port}: vented, waiting for `arm`"
        )

    # ------------------------------------------------------------------------------ inputs

    def _on_setpoint(self, message: PressureSetpoint, info: dict[str, int]) -> None:
        setpoint = Setpoint(
            stamp=nanoseconds(message.header.stamp),
            differential=tuple(message.differential_pressure),
            plan_id=message.plan_id,
            index=message.index,
            revision=message.revision,
        )
        self._offer(setpoint, self._setpoint_topic, info)

    def _on_cmd_u_t(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        """Untimed differences in hPa, as labs publish them from MATLAB."""
        differential = tuple(value * PASCAL_PER_HECTOPASCAL for value in message.data)
        self._offer(Setpoint(stamp=0, differential=differential), CMD_U_T, info)

    def _offer(self, setpoint: Setpoint, topic: str, info: dict[str, int]) -> None:
        number = info["publication_sequence_number"]
        alone = self.count_publishers(topic) <= 1
        verdict = self._core.offer(setpoint, time.time_ns(), Origin(topic, number, alone))
        if verdict is not Verdict.ACCEPTED:
            self.get_logger().warning(
                f"{verdict.value}: {self._core.last_refusal}", throttle_duration_sec=1.0
            )

    def _on_publishers(self, change: QoSSubscriptionMatchedInfo) -> None:
        if change.current_count_change < 0 and self._core.snapshot().mode is Mode.TRACKING:
            self.get_logger().warning(
                f"a publisher of {self._setpoint_topic} has gone while setpoints are played; "
                f"{change.current_count} left",
                throttle_duration_sec=1.0,
            )

    def _vent(self) -> tuple[bool, str]:
        answer = self._core.vent()
        self._link.urge()
        return answer

    def _refuse_simulated_time(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "use_sim_time" and parameter.value:
                return SetParametersResult(
                    successful=False, reason="'use_sim_time': the driver moves air in real time"
                )
        return SetParametersResult(successful=True)

    # ----------------------------------------------------------------------------- outputs

    def _on_tick(self) -> None:
        """Hand a picture of the tick to the executor; runs in the port's thread."""
        self._ticks.append(self._core.snapshot())
        self._guard.trigger()

    def _publish_ticks(self) -> None:
        self._write_log()
        for _ in range(len(self._ticks)):
            self._state_publisher.publish(self._state_message(self._ticks.popleft()))

    def _state_message(self, snapshot: Snapshot) -> PressureState:
        message = PressureState(
            mode=int(snapshot.mode),
            faults=list(snapshot.faults),
            commanded_differential=snapshot.commanded_differential,
            measured_differential=snapshot.measured_differential,
            commanded_chamber=snapshot.commanded_chamber,
            measured_chamber=snapshot.measured_chamber,
            valve_opening=snapshot.valve_opening,
            supply_pressure=snapshot.supply_pressure,
            telemetry_age=snapshot.telemetry_age,
            round_trip=snapshot.round_trip,
            setpoints_accepted=snapshot.counters.accepted,
            setpoints_executed=snapshot.counters.executed,
            setpoints_late=snapshot.counters.late,
            setpoints_duplicate=snapshot.counters.duplicate,
            setpoints_refused=snapshot.counters.refused,
            bytes_sent=self._link.bytes_sent,
            bytes_received=self._link.bytes_received,
        )
        message.header.stamp = stamp_from_nanoseconds(snapshot.tick)
        message.header.frame_id = topics.BASE_FRAME
        if snapshot.setpoint is not None:
            message.plan_id = snapshot.setpoint.plan_id
            message.index = snapshot.setpoint.index
            message.setpoint_stamp = stamp_from_nanoseconds(snapshot.setpoint.stamp)
        return message

    def _report(self) -> Health:
        snapshot = self._core.snapshot()
        obstacles = self._core.obstacles()
        protocol = self._core.protocol
        values: dict[str, object] = {
            "mode": snapshot.mode.name,
            "faults": "; ".join(snapshot.faults) or "none",
            "obstacles_to_arming": "; ".join(obstacles) or "none",
            "last_refusal": self._core.last_refusal or "none",
            "protocol": protocol.name,
            "protocol_weaknesses": "; ".join(protocol.weaknesses) or "none",
            "board": self._core.identity.firmware if self._core.identity else self._core.last_text,
            "atmosphere_pa": f"{self._core.atmosphere:.0f}",
            "telemetry_age_s": f"{snapshot.telemetry_age:.3f}",
            "round_trip_s": f"{snapshot.round_trip:.4f}",
            "damaged_frames": protocol.rejected,
            "last_damaged_line": protocol.last_damaged or "none",
            "setpoints_waiting": self._core.waiting,
            "setpoints_superseded": snapshot.counters.superseded,
            "setpoints_missing": snapshot.counters.missing,
            "setpoints_of_other_publishers": self._core.foreign_setpoints,
            "ticks_held_back_by_slew_limit": self._core.limited_ticks,
            "board_texts_not_logged": self._core.unlogged_texts,
            "ticks_missed": self._link.grid.missed,
            "clock_steps": self._link.grid.clock_steps,
            "reconnects": self._link.reconnects,
            "real_time_priority": self._link.real_time,
            "guardian": self._guardian_state(),
        }
        values.update(self._punctuality())
        level, text = self._judge(snapshot, obstacles)
        return Health(level, text, values)

    def _guardian_state(self) -> str:
        if self._guardian is None:
            return "none: the board's own watchdog" if self._core.protocol.has_watchdog else "none"
        return f"process {self._guardian.process_id}"

    def _punctuality(self) -> dict[str, object]:
        """Return how late the last minute's ticks began, and were with the operating system."""
        values: dict[str, object] = {}
        shares = {"p50": 0.5, "p99": 0.99, "max": 1.0}
        for name, times in (("wake", self._link.lateness), ("write", self._link.hand_over)):
            recent = sorted(times)
            for label, share in shares.items() if recent else ():
                late = recent[round(share * (len(recent) - 1))]
                values[f"tick_to_{name}_{label}_ms"] = f"{1000.0 * late:.3f}"
        return values

    def _judge(self, snapshot: Snapshot, obstacles: list[str]) -> tuple[str, str]:
        """Return the level and the sentence of the diagnostics."""
        weaknesses = self._core.protocol.weaknesses
        if snapshot.mode is Mode.FAULT:
            return "error", "FAULT: " + "; ".join(snapshot.faults)
        if snapshot.mode is Mode.DISARMED and obstacles:
            waiting = not math.isfinite(self._core.atmosphere)
            return ("stale" if waiting else "error"), "waiting for: " + "; ".join(obstacles)
        if weaknesses:
            return "warning", f"{snapshot.mode.name}; {self._core.protocol.name}: " + weaknesses[0]
        return "ok", snapshot.mode.name

    def _watch_threads(self) -> None:
        if self._guardian is not None:
            self._guardian.executor_lives()
        for what, error in (
            ("serial thread", self._link.error),
            ("thread of arm and vent", self._emergency.error),
        ):
            if error is not None:
                self.fatal_error = f"the {what} ended: {type(error).__name__}: {error}"

    def _log_from_thread(self, text: str, warning: bool) -> None:
        """Leave the writing to the executor: the port's thread has a clock to keep."""
        self._log_lines.append((text, warning))
        self._guard.trigger()

    def _write_log(self) -> None:
        for _ in range(min(len(self._log_lines), MOST_LINES)):
            text, warning = self._log_lines.popleft()
            # Two calls in two lines: rclpy remembers one severity for each place in the code.
            if warning:
                self.get_logger().warning(text)
            else:
                self.get_logger().info(text)

    def close(self) -> None:
        """Vent the board and release the port."""
        self._core.vent()
        ended = self._link.close()
        self._emergency.close()
        self._publish_ticks()
        if not ended:
            raise RuntimeError(f"the thread of {self._link.port} did not end; check the valves")
        if not self._link.vented_at_end:
            alone = " (a board with a watchdog vents by itself)"
            raise RuntimeError(
                f"the board on {self._link.port} cannot be reached and may hold its pressures"
                f"{alone if self._core.protocol.has_watchdog else ''}: close the air supply"
            )
        self.get_logger().info("vented and closed")


def main() -> int:
    """Run the driver until SIGINT or SIGTERM; the board is vented whatever ends it."""
    return run_node(PressureDriver)
