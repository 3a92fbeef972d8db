"""What makes a lab's own driver of valves a `native` board: its numbers, and what is watched."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from pressure_driver.emulator.device import BoardCommand, BoardReading
from pressure_driver.emulator.firmware import NativeBoard
from pressure_driver.settings import SettingError, TopicBoardSettings

STALE = 0.2
"""[s] after which readings are not told any more."""


class Scale:
    """Between the numbers of a lab's topic and gauge pressures.

    Args:
        settings: `scale` is what one Pa is on the topic, `offset` what is added to that; with
            `absolute` the room's pressure is part of it. `order` names, for each place of the
            lab's array, the chamber that stands there.

    Raises:
        SettingError: the order does not name every chamber once.
    """

    def __init__(self, settings: TopicBoardSettings) -> None:
        count = 2 * settings.segment_count
        named = [part.strip() for part in settings.order.split(",")]
        if sorted(named) != sorted(map(str, range(count))):
            raise SettingError(
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
