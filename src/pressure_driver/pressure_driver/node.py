"""The ROS node of the driver: topics, services and parameters before the port's process."""

from __future__ import annotations

import math
from collections import deque
from functools import partial
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from der_msgs.msg import OperatorLease, PressureSetpoint, PressureState
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import ParameterError, check_overrides, declare
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds
from pressure_driver.port_process import PortProcess
from pressure_driver.protocols.ezloop import PASCAL_PER_HECTOPASCAL
from pressure_driver.safety import Mode
from pressure_driver.settings import Declared, Settings, declarations

MOST_PRESSURES, LONGEST_NAME = 100, 200
"""Of a message; longer ones would not fit through the channel to the port's process."""
LIFE_PERIOD = 0.1
"""[s] between two signs of life to the port's process."""
CALLS = QoSProfile(depth=1000)
"""Of `arm` and `vent`: the middleware's depth of 10 loses requests that come at once."""
STATE_FIELDS = set(PressureState.get_fields_and_field_types()) - {"header", "setpoint_stamp"}
"""Of the message, by the names of the state; what else the state has is for the diagnostics."""
LATE_TICKS = 1200
"""Ticks over which it is told how late their bytes are written: a minute."""


def read_settings(node: Node, settings: type[Declared]) -> Declared:
    """Declare and check the parameters of a node, and refuse any that it does not have.

    Raises:
        ValueError: a value is out of range, or two contradict each other; names them.
    """
    values: dict[str, Any] = {}
    for name, declaration, default in declarations(settings):
        low, high = declaration.range or (None, None)
        values[name] = declare(
            node,
            name,
            default,
            declaration.description,
            at_least=low,
            at_most=high,
            choices=declaration.choices,
            read_only=not declaration.changeable,
        )
    check_overrides(node)
    return settings(**values)


class PressureDriver(Node):
    """Plays `pressure_setpoint`, publishes `pressure_state`, serves `arm` and `vent`."""

    def __init__(self) -> None:
        super().__init__("pressure_driver", namespace=topics.NAMESPACE)
        self.fatal_error = ""
        if self.get_parameter("use_sim_time").value:
            raise ParameterError(
                "parameter 'use_sim_time' is true: the driver moves air in real time; leave it out"
            )
        settings = read_settings(self, Settings)
        self._state: dict[str, Any] = {}
        self._late: deque[float] = deque(maxlen=LATE_TICKS)
        self._state_publisher = self.create_publisher(
            PressureState, topics.PRESSURE_STATE, qos.STATES
        )
        self._guard = self.create_guard_condition(self._publish)
        self._port = PortProcess(settings, self._guard.trigger)
        self._port.start()
        self._setpoint_topic = self.resolve_topic_name(topics.PRESSURE_SETPOINT)
        # Ready services are served in the order of their creation.
        for word in ("vent", "arm"):
            self.create_service(Trigger, f"~/{word}", partial(self._ask, word), qos_profile=CALLS)
        self.create_subscription(
            PressureSetpoint,
            topics.PRESSURE_SETPOINT,
            self._on_setpoint,
            qos.SETPOINTS,
        )
        self.create_subscription(OperatorLease, topics.OPERATOR_LEASE, self._on_lease, qos.LEASES)
        if settings.accept_cmd_u_t:
            self.create_subscription(
                Float64MultiArray, topics.CMD_U_T, self._on_cmd_u_t, qos.SETPOINTS
            )
        DiagnosticsPublisher(self, self._report, settings.port, clock_of_all=True)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(LIFE_PERIOD, self._show_life, clock=steady)
        self.get_logger().info(
            f"{settings.protocol} board on {settings.port}: commanded to vent, waiting for `arm`"
        )

    # ------------------------------------------------------------------------------ inputs

    def _on_setpoint(self, message: PressureSetpoint, info: dict[str, int]) -> None:
        setpoint = (
            nanoseconds(message.header.stamp),
            list(message.differential_pressure[:MOST_PRESSURES]),
            message.plan_id[:LONGEST_NAME],
            message.index,
            message.revision,
        )
        self._offer(setpoint, self._setpoint_topic, info)

    def _on_cmd_u_t(self, message: Float64MultiArray, info: dict[str, int]) -> None:
        """Untimed differences in hPa, as labs publish them from MATLAB."""
        differential = [value * PASCAL_PER_HECTOPASCAL for value in message.data[:MOST_PRESSURES]]
        self._offer((0, differential, "", 0, 0), topics.CMD_U_T, info)

    def _on_lease(self, message: OperatorLease) -> None:
        self._port.send("lease", message.source[:LONGEST_NAME], message.period)

    def _offer(self, setpoint: tuple[object, ...], topic: str, info: dict[str, int]) -> None:
        alone = self.count_publishers(topic) <= 1
        self._port.send("setpoint", *setpoint, topic, info["publication_sequence_number"], alone)

    def _ask(self, word: str, _: Trigger.Request, answer: Trigger.Response) -> Trigger.Response:
        answer.success, answer.message = self._port.ask(word)
        return answer

    def _show_life(self) -> None:
        self._port.send("alive")
        self.fatal_error = self._port.error

    # ----------------------------------------------------------------------------- outputs

    def _publish(self) -> None:
        """Publish and log what the port's process has said."""
        self._write_log()
        for _ in range(len(self._port.states)):
            state = self._state = self._port.states.popleft()
            self._late.append(state.pop("tick_to_write") / 1e6)
            message = PressureState(**{name: state[name] for name in STATE_FIELDS})
            message.header.stamp = stamp_from_nanoseconds(state.pop("tick"))
            message.header.frame_id = topics.BASE_FRAME
            message.setpoint_stamp = stamp_from_nanoseconds(state.pop("setpoint_stamp"))
            self._state_publisher.publish(message)

    def _write_log(self) -> None:
        for _ in range(len(self._port.log)):
            text, warning = self._port.log.popleft()
            # Two calls in two lines: rclpy remembers one severity for each place in the code.
            if warning:
                self.get_logger().warning(text)
            else:
                self.get_logger().info(text)

    def _report(self) -> Health:
        """Tell what the state has beside the message, and how late ticks are."""
        state, protocol = self._state, self._port.protocol
        if not state:
            return Health("stale", "starting")
        mode = Mode(state["mode"]).name
        late = sorted(self._late)
        percentiles = {"p50": 0.5, "p99": 0.99, "max": 1.0}
        values = {
            **{name: _written(value) for name, value in state.items() if name not in STATE_FIELDS},
            "faults": _written(state["faults"]),
            "telemetry_age_s": _written(state["telemetry_age"]),
            "round_trip_s": _written(state["round_trip"]),
            "mode": mode,
            "protocol": protocol.name,
            "protocol_weaknesses": _written(protocol.weaknesses),
            "port_process": self._port.process_id,
            **{
                f"tick_to_write_{label}_ms": _written(late[round(share * (len(late) - 1))])
                for label, share in percentiles.items()
            },
        }
        if state["faults"]:
            return Health("error", f"FAULT: {_written(state['faults'])}", values)
        if state["lost_operator"]:
            said = f"{mode}; the operator ({state['lost_operator']}) is lost: arm to go on"
            return Health("warning", said, values)
        if mode == "DISARMED" and state["obstacles_to_arming"]:
            level = "error" if math.isfinite(state["atmosphere_pa"]) else "stale"
            return Health(level, f"waiting for: {_written(state['obstacles_to_arming'])}", values)
        if protocol.weaknesses:
            return Health("warning", f"{mode}; {protocol.name}: {protocol.weaknesses[0]}", values)
        return Health("ok", mode, values)

    def close(self) -> None:
        """Vent the board and release the port."""
        problem = self._port.close()
        self._publish()
        if problem:
            raise RuntimeError(problem)
        self.get_logger().info("vented and closed")


def _written(value: object) -> str:
    """Return a value of the diagnostics as people read it."""
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return "; ".join(value) or "none"
    return str(value) or "none"


def main() -> int:
    """Run the driver until SIGINT or SIGTERM; the board is vented whatever ends it."""
    return run_node(PressureDriver)
