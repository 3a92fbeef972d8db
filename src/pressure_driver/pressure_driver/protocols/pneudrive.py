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
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pressure_driver.protocols import Echo, Event, FrameBuffer, HostProtocol, Telemetry

if TYPE_CHECKING:
    from pressure_driver.settings import EmulatorSettings, Settings

FRAME = struct.Struct(">5H")
FIRST_ADDRESS = 0xFFFF
"""Of board 0; the others count down from it."""
VALVES = 4
LARGEST_COUNT = 1023
NOMINAL_RANGE = 689_500.0
"""[Pa] of the sensors with 100 psi."""
_STEPS, _ZERO, _SPAN = 1024, 0.1, 0.8


class Frames(FrameBuffer):
    """Between gauge pressures and frames: the address, and four numbers of counts.

    Args:
        chamber_count: at most `VALVES`.
    """

    def __init__(self, chamber_count: int) -> None:
        super().__init__()
        self._count = chamber_count
        self._address, self._range = FIRST_ADDRESS, NOMINAL_RANGE

    def configure(self, settings: Settings | EmulatorSettings) -> None:
        """Take over the board's number and the range of its sensors."""
        self._address, self._range = FIRST_ADDRESS - settings.device, settings.sensor_range

    @property
    def resolution(self) -> float:
        """[Pa] of a count."""
        return self._range / (_STEPS * _SPAN)

    def encode(self, gauge: Sequence[float]) -> bytes:
        """Return a frame of gauge pressures [Pa]; valves without a chamber have none."""
        padded = [*gauge, *[0.0] * (VALVES - self._count)]
        counts = [round(_STEPS * _ZERO + value / self.resolution) for value in padded]
        return FRAME.pack(self._address, *(min(max(count, 0), LARGEST_COUNT) for count in counts))

    def feed(self, data: bytes) -> list[tuple[int, tuple[float, ...]]]:
        """Return (place of the first byte, gauge pressures [Pa]) of complete frames."""
        found: list[tuple[int, tuple[float, ...]]] = []
        self.kept += data
        while len(self.kept) >= FRAME.size:
            address, *counts = FRAME.unpack_from(self.kept)
            if address == self._address and max(counts) <= LARGEST_COUNT:
                pressures = [self.resolution * (n - _STEPS * _ZERO) for n in counts]
                found.append((self.position, tuple(pressures[: self._count])))
                self.take(FRAME.size)
            else:
                self.skip_to(self.kept.find(b"\xff", 1))
        return found


class PneudriveHost(HostProtocol):
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
    _frames: Frames

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count, Frames(chamber_count))
        self.resolution = self._frames.resolution

    def configure(self, settings: Settings) -> None:
        """Take over the board's number and the range of its sensors."""
        self._frames.configure(settings)
        self.resolution, self.reach = self._frames.resolution, settings.sensor_range

    def start(self) -> bytes:
        """Nothing: the board speaks when it is spoken to."""
        return b""

    def setpoint(self, gauge: Sequence[float]) -> tuple[bytes, int | None]:
        """Encode the targets."""
        return self._frames.encode(gauge), None

    def _interpret(self, gauge: tuple[float, ...]) -> list[Event]:
        """Return what was measured, and that a command was answered."""
        readings = tuple(self.assumed_atmosphere + pressure for pressure in gauge)
        return [Echo(), Telemetry(chamber_pressure=readings)]
