"""A valve board on a pseudo-terminal, with its air; here what its end of a protocol offers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from pressure_driver.protocols import ProtocolEnd


@dataclass(frozen=True)
class BoardCommand:
    """A command as the board understood it."""

    kind: str
    """``setpoint``, ``vent``, ``hello``, ``read`` or another word of the protocol."""
    pressure: tuple[float, ...] | None = None
    """(2M,) [Pa] as sent: absolute or gauge after the protocol's ``gauge``."""
    valid_for: float | None = None
    """[s] after which the board vents by itself."""
    sequence: int | None = None
    text: str = ""


@dataclass(frozen=True)
class BoardReading:
    """What the firmware tells at one instant."""

    time: float
    """[s] since boot."""
    chamber_pressure: tuple[float, ...]
    """(2M,) [Pa] absolute, with the sensors' errors."""
    atmosphere: float
    """[Pa] that the board took for the room's when it booted."""
    valve_opening: tuple[float, ...]
    supply_pressure: float
    last_sequence: int = 0
    vented: bool = True
    expired: bool = False
    """The board has vented since no setpoint came in time."""


class BoardProtocol(ProtocolEnd):
    """The firmware's end, for emulators and tests of firmware: it hears a `BoardCommand` each."""

    gauge: ClassVar[bool] = False
    """Whether the wire carries pressures above the atmosphere; else the differences of pairs."""

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self.boot(0.0)

    def boot(self, atmosphere: float) -> bytes:  # noqa: ARG002 - most boards say nothing
        """Return what the board says after power-up."""
        return b""

    def target(
        self,
        pressure: Sequence[float],
        time: float,  # noqa: ARG002 - most boards obey at once
    ) -> Sequence[float]:
        """Return what a setpoint makes the board regulate to (time since boot [s])."""
        return pressure

    def telemetry(self, reading: BoardReading) -> bytes:  # noqa: ARG002 - some only answer
        """Return the bytes of one telemetry report; nothing from boards that only answer."""
        return b""

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:  # noqa: ARG002
        """Return what the board answers to a command at once."""
        return b""

    def expired(self) -> bytes:
        """Return what the board says when it has vented since no setpoint came in time."""
        return b""
