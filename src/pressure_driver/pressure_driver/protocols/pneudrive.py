"""PneuDrive boards on an RS-485 bus at 1 Mbaud: four valves each, at most four boards.

One layout serves both directions: five numbers of 16 bits, big-endian::

    address (0xFFFF less the board's number, 0 … 3), four pressures in counts

To a board they are targets; its answer holds what it measures, and is sent before the targets are
stored. A gauge pressure p of sensors with the range R is 1024 (0.1 + 0.8 p / R) counts. There is no
checksum; a board drops a frame with more than 1023 counts. The bus is spoken on by one at a time:
a board is told when the one before has answered. One that is silent ends the round of this tick,
and the next round begins behind it. There is no watchdog, and a board vents for 2 s at its start.

Chambers 4n to 4n + 3 are those of board n.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pressure_driver.following import chamber_gauge
from pressure_driver.protocols import Echo, Event, FrameBuffer, HostProtocol, Telemetry

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

FRAME = struct.Struct(">5H")
VALVES = 4
"""Of a board."""
MOST_BOARDS = 4
LARGEST_COUNT = 1023
NOMINAL_RANGE = 689_500.0
"""[Pa] of the sensors with 100 psi."""
_STEPS, _ZERO, _SPAN = 1024, 0.1, 0.8
_FIRST_BYTE = b"\xff"


def counts_of(gauge: float, sensor_range: float) -> int:
    """Return a gauge pressure [Pa] in counts, at most what a board takes."""
    return min(round(_STEPS * (_ZERO + _SPAN * gauge / sensor_range)), LARGEST_COUNT)


def gauge_of(counts: int, sensor_range: float) -> float:
    """Return the gauge pressure [Pa] of a number of counts."""
    return sensor_range * (counts / _STEPS - _ZERO) / _SPAN


class TargetReader(FrameBuffer):
    """Cuts a byte stream into frames: an address, and four numbers of counts that there can be."""

    def feed(self, data: bytes) -> list[tuple[int, int, tuple[int, ...]]]:
        """Return (place of the first byte, number of the board, counts) of complete frames."""
        found: list[tuple[int, int, tuple[int, ...]]] = []
        self.kept += data
        while len(self.kept) >= FRAME.size:
            address, *counts = FRAME.unpack_from(self.kept)
            board = 0xFFFF - address
            if board < MOST_BOARDS and max(counts) <= LARGEST_COUNT:
                found.append((self.position, board, tuple(counts)))
                self.take(FRAME.size)
            else:
                self.skip_to(self.kept.find(_FIRST_BYTE, 1))
        return found


class PneudriveHost(HostProtocol):
    """The driver's end of ``pneudrive``."""

    name = "pneudrive"
    baud_rate = 1_000_000
    weaknesses = (
        "no watchdog: if this computer dies, the boards keep the last pressures",
        "no checksum: a damaged number can pass for a pressure",
        "one count of the sensors is a thousandth of their range: 0.84 kPa of 100 psi",
    )
    separator = b""
    echoes = True

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self._board_count = -(-chamber_count // VALVES)
        self._frames = TargetReader()
        self._set_range(NOMINAL_RANGE)
        self._first = 0
        self.reset()

    def configure(self, settings: Settings) -> None:
        """Take over the range of the sensors."""
        self._set_range(settings.sensor_range)

    def _set_range(self, sensor_range: float) -> None:
        self._range = sensor_range
        self.resolution = sensor_range / (_STEPS * _SPAN)

    def reset(self) -> None:
        """Forget a half-received frame and the round that it belonged to."""
        self._frames.reset()
        self._untold: deque[tuple[int, bytes]] = deque()
        self._asked: int | None = None
        self._follow_up = b""
        self._measured: dict[int, tuple[int, ...]] = {}

    def start(self) -> bytes:
        """Nothing: a board speaks when it is spoken to."""
        return b""

    def setpoint(
        self,
        differential: Sequence[float],
        atmosphere: float,  # noqa: ARG002 - the wire carries gauge pressures
        valid_for: float,  # noqa: ARG002 - the boards have no watchdog
    ) -> tuple[bytes, int | None]:
        """Encode the targets, and return those of the first board of this round."""
        if self._asked is not None:
            self._first = (self._asked + 1) % self._board_count  # it has not answered
        frames = list(enumerate(self._encode(differential)))
        self._untold = deque(frames[self._first :] + frames[: self._first])
        return self._tell_next(), None

    def emergency(self, atmosphere: float) -> list[bytes]:  # noqa: ARG002
        """One frame a board, to be sent in turn."""
        return self._encode([0.0] * (self.chamber_count // 2))

    def _encode(self, differential: Sequence[float]) -> list[bytes]:
        """Return one frame a board; valves that have no chamber are told to vent."""
        gauge = chamber_gauge(differential)
        gauge += [0.0] * (VALVES * self._board_count - len(gauge))
        counts = [counts_of(value, self._range) for value in gauge]
        return [
            FRAME.pack(0xFFFF - board, *counts[VALVES * board : VALVES * (board + 1)])
            for board in range(self._board_count)
        ]

    def _tell_next(self) -> bytes:
        if not self._untold:
            self._asked = None
            return b""
        self._asked, data = self._untold.popleft()
        return data

    def decode(self, data: bytes) -> list[Event]:
        """Return what was measured once every board has told it, and that the round is over."""
        before = self._frames.rejected
        events: list[Event] = []
        for _, board, counts in self._frames.feed(data):
            if board >= self._board_count:
                self.rejected += 1
                continue
            self._measured[board] = counts
            if board == self._asked:
                self._follow_up = self._tell_next()
                events += [Echo()] if self._asked is None else []
            if len(self._measured) == self._board_count:
                events.append(self._telemetry())
        self.rejected += self._frames.rejected - before
        return events

    def _telemetry(self) -> Telemetry:
        counts = [count for board in sorted(self._measured) for count in self._measured[board]]
        self._measured.clear()
        return Telemetry(
            chamber_pressure=tuple(
                self.assumed_atmosphere + gauge_of(count, self._range)
                for count in counts[: self.chamber_count]
            )
        )
