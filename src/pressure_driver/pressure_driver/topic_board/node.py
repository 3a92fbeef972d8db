"""A lab's own driver of valves as a board: pressures go out on its topic and come back on another.

To the pressure driver this node is a `native` board at `tcp://host:port`: the driver watches it as
it watches other boards. As a native board must, this node vents by itself when setpoints cease.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Float64MultiArray, Header

from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.runner import run_node
from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.emulator.line import BoardSocket
from pressure_driver.node import read_settings
from pressure_driver.settings import TopicBoardSettings
from pressure_driver.topic_board import WatchedBoard, from_topic, to_topic

LOOK = 0.005
"""[s] between two looks for bytes of the driver."""
DEPTH = 10
"""Messages that wait."""


class TopicBoard(Node):
    """Listens to the driver, publishes pressures for the lab's valves and reads them back."""

    def __init__(self) -> None:
        super().__init__("topic_board", namespace=topics.NAMESPACE)
        settings = self._settings = read_settings(self, TopicBoardSettings)
        self._count = 2 * settings.segment_count
        firmware = NativeBoard(self._count, round(settings.largest_pressure), known=0)
        self._board = WatchedBoard(firmware, self._publish)
        self._told: dict[int, list[float]] = {}
        self._refused = ""
        self._arrays = settings.message == "Float64MultiArray"
        kind = Float64MultiArray if self._arrays else FluidPressure
        places = range(1 if self._arrays else self._count)
        commands = [settings.command_topic.replace("{}", str(place)) for place in places]
        self._regulators = [self.create_publisher(kind, topic, DEPTH) for topic in commands]
        self._heard = [settings.measured_topic.replace("{}", str(place)) for place in places]
        for place, topic in enumerate(self._heard):
            # Best effort hears reliable publishers as well.
            self.create_subscription(kind, topic, partial(self._take, place), qos.SENSOR_DATA)
        self._socket = BoardSocket(settings.listen)
        self.create_timer(LOOK, self._serve)
        DiagnosticsPublisher(self, self._report, hardware_id=settings.listen)

    def _serve(self) -> None:
        now = time.monotonic()
        if data := self._socket.read():
            self._socket.send(self._board.receive(data, now))
        self._socket.send(self._board.look(now))

    def _publish(self, gauge: Sequence[float]) -> None:
        values = to_topic(gauge, self._settings)
        header = Header(stamp=self.get_clock().now().to_msg())
        for publisher, value in zip(self._regulators, values, strict=False):
            publisher.publish(
                Float64MultiArray(data=values)
                if self._arrays
                else FluidPressure(header=header, fluid_pressure=value)
            )

    def _take(self, place: int, message: Float64MultiArray | FluidPressure) -> None:
        """Take pressures of one topic; the last of a set makes a report."""
        self._told[place] = list(message.data if self._arrays else [message.fluid_pressure])
        if len(self._told) < len(self._heard):
            return
        told = [value for _, values in sorted(self._told.items()) for value in values]
        self._told.clear()
        try:
            gauge = from_topic(told, self._settings)
        except ValueError as error:
            self._refused = str(error)
            return
        self._refused = ""
        self._socket.send(self._board.measured(gauge, time.monotonic()))

    def _report(self) -> Health:
        problem, present = self._refused, self._socket.host_present
        if not problem and not self._board.hears(time.monotonic()):
            silent = [topic for place, topic in enumerate(self._heard) if place not in self._told]
            problem = f"no pressures are measured on {', '.join(silent)}"
        text = problem or ("regulating" if present else "no driver")
        return Health("error" if problem else "ok", text, {"host_present": present})

    def close(self) -> None:
        """Vent, whoever may have died before, and leave the network."""
        self._publish([0.0] * self._count)
        self._socket.close()


def main() -> int:
    """Run the node until SIGINT or SIGTERM."""
    return run_node(TopicBoard)
