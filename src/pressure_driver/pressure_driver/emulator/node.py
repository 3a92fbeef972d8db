"""The ROS node of the emulated valve board. It publishes what the twin needs and takes nothing."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from functools import partial

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from der_msgs.msg import ChamberPressures
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import stamp_from_nanoseconds
from pressure_driver.emulator.board import EmulatedBoard, FaultError, Faults
from pressure_driver.emulator.firmware import BOARDS
from pressure_driver.emulator.line import emulated_line
from pressure_driver.emulator.pneumatics import BoardPneumatics
from pressure_driver.emulator.runner import BoardRunner
from pressure_driver.node import read_settings
from pressure_driver.protocols import order_of
from pressure_driver.settings import EmulatorSettings


class BoardEmulator(Node):
    """A valve board on a pseudo-terminal, with its air."""

    def __init__(self) -> None:
        super().__init__("board_emulator", namespace=topics.NAMESPACE)
        self.fatal_error = ""
        settings = read_settings(self, EmulatorSettings)
        count = 2 * settings.segment_count
        hoses = order_of(settings.wiring, count)
        pneumatics = BoardPneumatics(settings.segment_count, settings.seed, hoses)
        protocol = BOARDS[settings.protocol](count)
        protocol.configure(settings)
        self._board = EmulatedBoard(protocol, pneumatics, settings.seed)
        faults = self._parse(settings.faults)  # before the port stands where others see it
        self._port = emulated_line(settings.port_link)
        self._unpublished: deque[tuple[str, int, Sequence[float]]] = deque(maxlen=1000)
        self._sequences: Counter[str] = Counter()
        self._guard = self.create_guard_condition(self._publish)
        self._topic_publishers = {
            topic: self.create_publisher(ChamberPressures, topic, profile)
            for topic, profile in (
                (topics.TWIN_CHAMBER_PRESSURES, qos.STATES),
                (topics.TWIN_BOARD_COMMANDS, qos.SETPOINTS),
            )
        }
        self._runner = BoardRunner(
            self._board,
            self._port,
            lambda stamp, air: self._keep(topics.TWIN_CHAMBER_PRESSURES, stamp, air.tolist()),
            partial(self._keep, topics.TWIN_BOARD_COMMANDS),
            settings.real_time_priority,
        )
        self._runner.set_faults(faults)
        self.add_on_set_parameters_callback(self._on_parameters)
        self._runner.start()
        DiagnosticsPublisher(self, self._report, hardware_id=self._port.link)
        self.create_timer(0.2, self._watch)
        self.get_logger().info(f"{settings.protocol} board on {self._port.link}")

    def _parse(self, text: str) -> Faults:
        return Faults.parse(text.split(","), self._board.pneumatics.chamber_count)

    def _on_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            if parameter.name == "faults":
                try:
                    faults = self._parse(parameter.value)
                except FaultError as error:
                    return SetParametersResult(successful=False, reason=str(error))
                self._runner.set_faults(faults)
                self.get_logger().info(f"faults: {parameter.value or 'none'}")
        return SetParametersResult(successful=True)

    def _keep(self, topic: str, stamp: int, pressure: Sequence[float]) -> None:
        self._unpublished.append((topic, stamp, pressure))
        self._guard.trigger()

    def _publish(self) -> None:
        while self._unpublished:
            topic, stamp, pressure = self._unpublished.popleft()
            message = ChamberPressures(sequence=self._sequences[topic], pressure=pressure)
            message.header.stamp = stamp_from_nanoseconds(stamp)
            self._sequences[topic] += 1
            self._topic_publishers[topic].publish(message)

    def _report(self) -> Health:
        faults = self.get_parameter("faults").value
        values = {
            "port": self._port.link,
            "host_present": self._port.host_present,
            "commands_received": self._sequences[topics.TWIN_BOARD_COMMANDS],
            "commands_rejected": self._board.protocol.rejected,
            "faults": faults or "none",
        }
        if faults:
            return Health("warning", f"emulated faults: {faults}", values)
        return Health("ok", "regulating", values)

    def _watch(self) -> None:
        self.fatal_error = self._runner.error

    def close(self) -> None:
        """Remove the port."""
        self._runner.close()


def main() -> int:
    """Run the emulated board until SIGINT or SIGTERM."""
    return run_node(BoardEmulator)
