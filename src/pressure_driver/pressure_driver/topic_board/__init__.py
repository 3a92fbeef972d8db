"""What makes a lab's own driver of valves a `native` board: its numbers, and what is watched."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

from pressure_driver.emulator import BoardReading
from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.protocols import STANDARD_ATMOSPHERE
from pressure_driver.settings import TopicBoardSettings

STALE = 0.2
"""[s] after which readings are not told any more."""


def to_topic(gauge: Sequence[float], settings: TopicBoardSettings) -> list[float]:
    """Return what a lab is told for gauge pressures (2M,) [Pa]."""
    return [value * settings.scale + settings.offset for value in gauge]


def from_topic(told: Sequence[float], settings: TopicBoardSettings) -> list[float]:
    """Return gauge pressures (2M,) [Pa] for what a lab tells.

    Raises:
        ValueError: it does not tell one number for each chamber.
    """
    count = 2 * settings.segment_count
    if len(told) != count or not all(map(math.isfinite, told)):
        listed = ", ".join(f"{value:g}" for value in told)
        raise ValueError(f"measured is {listed}: {count} numbers are expected")
    return [(value - settings.offset) / settings.scale for value in told]


class WatchedBoard:
    """What a native board does, with pressures that are regulated somewhere else.

    Args:
        firmware: the board's end of the protocol.
        regulate: takes gauge pressures (2M,) [Pa], all zero to vent.
    """

    def __init__(self, firmware: NativeBoard, regulate: Callable[[Sequence[float]], None]) -> None:
        self._firmware, self._regulate = firmware, regulate
        count = firmware.chamber_count
        self._zero = (0.0,) * count
        room = STANDARD_ATMOSPHERE
        self._reading = BoardReading(0.0, (room,) * count, room, self._zero, 0.0)
        self._valid_until = math.inf
        self._measured_at = -math.inf

    def hears(self, now: float) -> bool:
        """Tell whether pressures have been measured just now (steady clock [s])."""
        return now - self._measured_at < STALE

    def receive(self, data: bytes, now: float) -> bytes:
        """Execute the commands of the driver; return the answers (steady clock [s])."""
        answers = b""
        for command in self._firmware.decode(data):
            if command.kind in ("setpoint", "vent"):
                self._valid_until = now + (command.valid_for or math.inf)
                vented, number = command.kind == "vent", command.sequence or 0
                self._reading = replace(
                    self._reading, last_sequence=number, vented=vented, expired=False
                )
                self._regulate(command.pressure or self._zero)
            # An answer holds readings: old ones would pass for new ones.
            if self.hears(now) or command.kind in ("hello", "refused"):
                answers += self._firmware.reply(command, replace(self._reading, time=now))
        return answers

    def look(self, now: float) -> bytes:
        """Vent if the last setpoint is not valid any more; return what is to be said about it."""
        if now <= self._valid_until:
            return b""
        self._valid_until = math.inf
        self._reading = replace(self._reading, vented=True, expired=True)
        self._regulate(self._zero)
        return self._firmware.expired()

    def measured(self, gauge: Sequence[float], now: float) -> bytes:
        """Take gauge pressures (2M,) [Pa]; return the report for the driver."""
        absolute = tuple(self._reading.atmosphere + pressure for pressure in gauge)
        self._measured_at = now
        self._reading = replace(self._reading, time=now, chamber_pressure=absolute)
        return self._firmware.telemetry(self._reading)
