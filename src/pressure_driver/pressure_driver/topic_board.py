"""A lab's own driver of valves as a board: pressures go out on its topic and come back on another.

To the pressure driver this node is a `native` board at `tcp://host:port`, so that everything which
that watches is watched here as well. What a native board has to do by itself it does, too: it vents
when setpoints cease to come.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial

from rclpy.node import Node
from sensor_msgs.msg import FluidPressure
from std_msgs.msg import Float64MultiArray

from limb_interfaces import topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import ParameterError
from limb_interfaces.runner import run_node
from pressure_driver.board_socket import BoardSocket
from pressure_driver.emulator.device import BoardCommand, BoardReading
from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.node import read_settings
from pressure_driver.settings import TopicBoardSettings

LOOK = 0.005
"""[s] between two looks for bytes of the driver."""
STALE = 0.2
"""[s] after which readings are not told any more."""
DEPTH = 10
"""Messages that wait."""


class Scale:
    """Between the numbers of a lab's topic and gauge pressures.

    Args:
        settings: `scale` is what one Pa is on the topic, `offset` what is added to that; with
            `absolute` the room's pressure is part of it. `order` names, for each place of the
            lab's array, the chamber that stands there.

    Raises:
        ParameterError: the order does not name every chamber once.
    """

    def __init__(self, settings: TopicBoardSettings) -> None:
        count = 2 * settings.segment_count
        named = [part.strip() for part in settings.order.split(",")]
        if sorted(named) != sorted(map(str, range(count))):
            raise ParameterError(
                f"parameter 'order' is '{settings.order}': name each of the chambers 0 to "
                f"{count - 1} once, as in '0,1,2,3'"
            )
        self.order = [int(part) for part in named]
        self._scale, self._offset = settings.scale, settings.offset
        self._room = settings.atmosphere if settings.absolute else 0.0

    def to_topic(self, gauge: Sequence[float]) -> list[float]:
        """Return what a lab is told, in its order, for gauge pressures (2M,) [Pa]."""
        values = [(pressure + self._room) * self._scale + self._offset for pressure in gauge]
        return [values[chamber] for chamber in self.order]

    def from_topic(self, told: Sequence[float]) -> list[float]:
        """Return gauge pressures (2M,) [Pa] for what a lab tells, in its order."""
        gauge = [0.0] * len(self.order)
        for chamber, value in zip(self.order, told, strict=True):
            gauge[chamber] = (value - self._offset) / self._scale - self._room
        return gauge


class WatchedBoard:
    """What a native board does, with pressures that are regulated somewhere else.

    Args:
        firmware: the board's end of the protocol.
        atmosphere: [Pa] of the room.
        regulate: takes gauge pressures (2M,) [Pa], all zero to vent.
    """

    def __init__(
        self,
        firmware: NativeBoard,
        atmosphere: float,
        regulate: Callable[[Sequence[float]], None],
    ) -> None:
        self._firmware = firmware
        self._atmosphere = atmosphere
        self._regulate = regulate
        self._zero = (0.0,) * firmware.chamber_count
        self._valid_until: float | None = None
        self._sequence = 0
        self._expired = False
        self._vented = True
        self._gauge: Sequence[float] = self._zero
        self._measured_at = -math.inf

    def receive(self, data: bytes, now: float) -> bytes:
        """Execute the commands of the driver; return the answers (steady clock [s])."""
        answers = b""
        for command in self._firmware.decode(data):
            if command.kind in ("setpoint", "vent"):
                self._execute(command, now)
            # An answer holds readings: old ones would pass for new ones.
            fresh = now - self._measured_at < STALE
            if fresh or command.kind in ("hello", "refused"):
                answers += self._firmware.reply(command, self._reading(now))
        return answers

    def _execute(self, command: BoardCommand, now: float) -> None:
        self._sequence = command.sequence or 0
        self._expired, self._vented = False, command.kind == "vent"
        valid_for = command.valid_for
        self._valid_until = None if valid_for is None else now + valid_for
        self._regulate(command.pressure or self._zero)

    def look(self, now: float) -> bytes:
        """Vent if the last setpoint is not valid any more; return what is to be said about it."""
        if self._valid_until is None or now <= self._valid_until:
            return b""
        self._valid_until = None
        self._expired = self._vented = True
        self._regulate(self._zero)
        return self._firmware.expired()

    def measured(self, gauge: Sequence[float], now: float) -> bytes:
        """Take gauge pressures (2M,) [Pa]; return the report for the driver."""
        self._gauge, self._measured_at = gauge, now
        return self._firmware.telemetry(self._reading(now))

    def _reading(self, now: float) -> BoardReading:
        return BoardReading(
            time=now,
            chamber_pressure=tuple(self._atmosphere + p for p in self._gauge),
            atmosphere=self._atmosphere,
            valve_opening=self._zero,
            supply_pressure=0.0,
            last_sequence=self._sequence,
            vented=self._vented,
            expired=self._expired,
        )


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
