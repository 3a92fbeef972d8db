"""A lab's own driver of valves as a board: pressures go out on its topic and come back on another.

To the pressure driver this node is a `native` board at `tcp://host:port`, so that everything which
that watches is watched here as well. What a native board has to do by itself it does, too: it vents
when setpoints cease to come.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Float64MultiArray

from limb_interfaces import topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.runner import run_node
from pressure_driver.board_socket import BoardSocket
from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.node import read_settings
from pressure_driver.settings import TopicBoardSettings
from pressure_driver.topic_board.board import Scale, WatchedBoard

LOOK = 0.005
"""[s] between two looks for bytes of the driver."""
DEPTH = 10
"""Messages that wait."""


class TopicBoard(Node):
    """Listens to the driver, publishes pressures for the lab's valves and reads them back."""

    def __init__(self) -> None:
        super().__init__("topic_board", namespace=topics.NAMESPACE)
        settings = read_settings(self, TopicBoardSettings)
        self._scale = Scale(settings)
        self._count = 2 * settings.segment_count
        firmware = NativeBoard(self._count, round(settings.largest_pressure), known=0)
        self._board = WatchedBoard(firmware, settings.atmosphere, self._publish)
        self._told: list[float | None] = [None] * self._count
        self._refused = ""
        arrays = settings.message == "Float64MultiArray"
        kind = Float64MultiArray if arrays else FluidPressure
        places = 1 if arrays else self._count
        names = [settings.command_topic.replace("{}", str(place)) for place in range(places)]
        heard = [settings.measured_topic.replace("{}", str(place)) for place in range(places)]
        self._publishers = [self.create_publisher(kind, name, DEPTH) for name in names]
        for place, name in enumerate(heard):
            take = self._take_array if arrays else partial(self._take_one, place)
            self.create_subscription(kind, name, take, DEPTH)
        self._socket = BoardSocket(settings.listen)
        self.create_timer(LOOK, self._serve)
        DiagnosticsPublisher(self, self._report, hardware_id=settings.listen)

    def _serve(self) -> None:
        now = time.monotonic()
        self._socket.read(time.time_ns())
        for _, data in self._socket.arrived(0):
            self._socket.send(self._board.receive(data, now))
        self._socket.send(self._board.look(now))
        self._socket.pump(0)

    def _publish(self, gauge: Sequence[float]) -> None:
        values = self._scale.to_topic(gauge)
        if len(self._publishers) == 1:
            self._publishers[0].publish(Float64MultiArray(data=values))
            return
        stamp = self.get_clock().now().to_msg()
        for publisher, value in zip(self._publishers, values, strict=True):
            message = FluidPressure(fluid_pressure=value)
            message.header.stamp = stamp
            publisher.publish(message)

    def _take_array(self, message: Float64MultiArray) -> None:
        self._take(list(message.data))

    def _take_one(self, place: int, message: FluidPressure) -> None:
        """Take one chamber's pressure; the last of a set makes a report."""
        self._told[place] = message.fluid_pressure
        told = [value for value in self._told if value is not None]
        if len(told) == self._count:
            self._told = [None] * self._count
            self._take(told)

    def _take(self, told: list[float]) -> None:
        self._refused = ""
        if len(told) != self._count:
            self._refused = f"{len(told)} pressures are measured, there are {self._count} chambers"
            return
        gauge = self._scale.from_topic(told)
        self._socket.send(self._board.measured(gauge, time.monotonic()))
        self._socket.pump(0)

    def _report(self) -> Health:
        values = {"host_present": self._socket.host_present}
        if self._refused:
            return Health("error", self._refused, values)
        return Health("ok", "regulating" if self._socket.host_present else "no driver", values)

    def close(self) -> None:
        """Vent, whoever may have died before, and leave the network."""
        self._publish([0.0] * self._count)
        self._socket.close()


def main() -> int:
    """Run the node until SIGINT or SIGTERM."""
    return run_node(TopicBoard)
