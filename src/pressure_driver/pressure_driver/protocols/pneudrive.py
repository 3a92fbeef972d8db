"""A PneuDrive board on an RS-485 line at 1 Mbaud, with four valves.

One layout serves both directions: five numbers of 16 bits, big-endian::

    address (0xFFFF less the board's number, 0 to 3), four pressures in counts

To the board they are targets; its answer holds what it measures, and is sent before the targets are
stored. A gauge pressure p of sensors with the range R is 1024 (0.1 + 0.8 p / R) counts. There is no
checksum; the board drops a frame with more than 1023 counts. There is no watchdog, and the board
vents for 2 s at its start.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from pressure_driver.protocols import (
    Echo,
    Event,
    HostProtocol,
    ProtocolEnd,
    Telemetry,
    skip_to,
)

if TYPE_CHECKING:
    from pressure_driver.settings import EmulatorSettings, Settings

FRAME = struct.Struct(">5H")
FIRST_ADDRESS = 0xFFFF
"""Of board 0; the others count down from it."""
VALVES = 4
LARGEST_COUNT = 1023
NOMINAL_RANGE = 689_500.0
"""[Pa] of the sensors with 100 psi."""
ZERO, COUNTS = 102.4, 819.2
"""Counts of no pressure, and between that and the range of the sensors."""


class PneudriveEnd(ProtocolEnd):
    """Either end: frames of an address and four numbers of counts."""

    _address = FIRST_ADDRESS
    reach = NOMINAL_RANGE
    """[Pa] of the sensors."""
    resolution = NOMINAL_RANGE / COUNTS
    """[Pa] of a count."""

    def configure(self, settings: Settings | EmulatorSettings) -> None:
        """Take over the board's number and the range of its sensors."""
        self._address = FIRST_ADDRESS - settings.device
        self.reach, self.resolution = settings.sensor_range, settings.sensor_range / COUNTS

    def encode(self, gauge: Sequence[float]) -> bytes:
        """Return a frame of gauge pressures [Pa]; valves without a chamber have none."""
        padded = [*gauge, *[0.0] * (VALVES - self.chamber_count)]
        counts = [round(ZERO + value / self.resolution) for value in padded]
        return FRAME.pack(self._address, *(min(max(count, 0), LARGEST_COUNT) for count in counts))

    def _cut(self) -> Iterator[tuple[float, ...] | None]:
        """Take the gauge pressures [Pa] of complete frames."""
        kept = self._kept
        while len(kept) >= FRAME.size:
            address, *counts = FRAME.unpack_from(kept)
            if address == self._address and max(counts) <= LARGEST_COUNT:
                del kept[: FRAME.size]
                yield tuple(self.resolution * (n - ZERO) for n in counts[: self.chamber_count])
            else:
                skip_to(kept.find(b"\xff", 1), kept)
                yield None


class PneudriveHost(PneudriveEnd, HostProtocol):
    """The driver's end of ``pneudrive``."""

    name = "pneudrive"
    baud_rate = 1_000_000
    weaknesses = (
        "no watchdog: if this computer dies, the board keeps the last pressures",
        "no checksum: a damaged number can pass for a pressure",
        "one count of the sensors is a thousandth of their range: 0.84 kPa of 100 psi",
    )
    separator = b""
    echoes = True

    def start(self) -> bytes:
        """Nothing: the board speaks when it is spoken to."""
        return b""

    def setpoint(self, gauge: Sequence[float]) -> bytes:
        """Encode the targets."""
        return self.encode(gauge)

    def _interpret(self, gauge: tuple[float, ...]) -> list[Event]:
        """Return what was measured, and that a command was answered."""
        readings = tuple(self.assumed_atmosphere + pressure for pressure in gauge)
        return [Echo(), Telemetry(chamber_pressure=readings)]
