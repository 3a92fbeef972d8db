"""What every board protocol offers to the two ends of the line.

Decoders take any split of the byte stream, throw nothing, and count what they had to reject.
Pressures are in Pa on this side of a protocol, whatever unit the wire carries.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

STANDARD_ATMOSPHERE = 101_325.0
"""[Pa]"""
LONGEST_LINE = 512
"""[bytes] A longer line is garbage: its bytes are dropped up to the next line end."""
LONGEST_SHOWN = 80
"""[characters] of a damaged line that are kept to be shown."""


@dataclass(frozen=True)
class Telemetry:
    """What a board has measured; None where this message says nothing about it."""

    chamber_pressure: tuple[float, ...] | None = None
    """(2M,) [Pa] absolute, as the board's sensors read."""
    valve_opening: tuple[float, ...] | None = None
    """(2M,) 0 … 1."""
    supply_pressure: float | None = None
    """[Pa] absolute, of the reservoir."""


@dataclass(frozen=True)
class Echo:
    """The board repeats that it has received a command."""

    sequence: int | None = None
    """Number of the command; None where the protocol has none: the newest command."""


@dataclass(frozen=True)
class BoardReport:
    """The board says that it is in trouble, or that it has acted on its own."""

    text: str
    fatal: bool


@dataclass(frozen=True)
class BoardReset:
    """The board has started again: it is vented and has forgotten its settings."""

    sign: str
    """From what this is concluded; of a few fixed texts."""


@dataclass(frozen=True)
class BoardText:
    """Free text of the board: boot messages, warnings."""

    text: str


@dataclass(frozen=True)
class BoardIdentity:
    """What the board says of itself when asked."""

    chamber_count: int
    smallest_pressure: float
    """[Pa] gauge."""
    largest_pressure: float
    """[Pa] gauge."""
    firmware: str


Event = Telemetry | Echo | BoardReport | BoardReset | BoardText | BoardIdentity


class StreamCutter:
    """Collects bytes and returns complete pieces with the place of their first byte.

    Args:
        end: the byte after each piece.
        longest: bytes; of a longer piece everything up to its end is dropped.
    """

    def __init__(self, end: bytes, longest: int) -> None:
        self._end = end
        self._longest = longest
        self._buffer = bytearray()
        self._position = 0
        self._overlong = False

    def feed(self, data: bytes) -> list[tuple[int, bytes | None]]:
        """Return (place of the first byte, piece without its end); None for one too long."""
        pieces: list[tuple[int, bytes | None]] = []
        self._buffer += data
        while (end := self._buffer.find(self._end)) >= 0:
            too_long = self._overlong or end > self._longest
            pieces.append((self._position, None if too_long else bytes(self._buffer[:end])))
            del self._buffer[: end + 1]
            self._position += end + 1
            self._overlong = False
        if len(self._buffer) > self._longest:
            self._position += len(self._buffer)
            self._buffer.clear()
            self._overlong = True
        return pieces

    def reset(self) -> None:
        """Forget a half-received piece."""
        self._position += len(self._buffer)
        self._buffer.clear()
        self._overlong = False


class LineSplitter:
    """Collects bytes and returns complete lines with the place of their first byte.

    Lines end with a line feed; carriage returns and blanks at either end are dropped, and so are
    empty lines. Bytes outside printable ASCII (and tab) make a line damaged.
    """

    def __init__(self) -> None:
        self._pieces = StreamCutter(b"\n", LONGEST_LINE)
        self.damaged = 0

    def feed(self, data: bytes) -> list[tuple[int, str]]:
        """Return the lines completed by ``data`` as (place of the first byte, text)."""
        lines: list[tuple[int, str]] = []
        for start, raw in self._pieces.feed(data):
            if raw is None:
                self.damaged += 1
                continue
            leading = len(raw) - len(raw.lstrip())
            text = raw.strip()
            if not text:
                continue
            if any(byte != 9 and not 32 <= byte < 127 for byte in text):
                self.damaged += 1
                continue
            lines.append((start + leading, text.decode("ascii")))
        return lines

    def reset(self) -> None:
        """Forget a half-received line."""
        self._pieces.reset()


class HostProtocol(ABC):
    """The driver's end: encodes commands, decodes what the board says.

    Args:
        chamber_count: 2M, even.

    Raises:
        ValueError: the protocol cannot serve so many chambers.
    """

    name: ClassVar[str]
    baud_rate: ClassVar[int] = 115200
    weaknesses: ClassVar[tuple[str, ...]] = ()
    """What the protocol cannot protect from; shown in the diagnostics."""
    reports_supply: ClassVar[bool] = False
    has_watchdog: ClassVar[bool] = False
    introduces_itself: ClassVar[bool] = False
    """Whether the board answers `start` with a `BoardIdentity`."""
    separator: ClassVar[bytes] = b"\n"
    """What makes the board drop or finish whatever was sent by halves."""
    echoes: ClassVar[bool] = False
    """Whether the board repeats every command (`Echo`)."""
    tells_pascals: ClassVar[bool] = False
    """Whether pressures are told finely enough that those of a working sensor always tremble."""
    assumed_atmosphere: float = STANDARD_ATMOSPHERE
    """[Pa] added to the reports of boards that only know gauge pressures."""

    def __init__(self, chamber_count: int = 4) -> None:
        if chamber_count < 2 or chamber_count % 2:
            raise ValueError(f"chamber_count must be even and positive, got {chamber_count}")
        self.chamber_count = chamber_count
        self.rejected = 0
        """Frames or lines that were damaged and thrown away."""
        self.last_damaged = ""
        """The newest of them, where the protocol has lines."""
        self.unsettled = ""
        """Why no pressure may be commanded yet, though the board talks; empty if it may."""

    def doubt(self) -> None:  # noqa: B027 - most boards have no settings
        """Trust no setting of the board any more, as after it has been silent."""

    @abstractmethod
    def start(self) -> bytes:
        """Return what a board must be sent after the port has opened."""

    @abstractmethod
    def setpoint(
        self, differential: Sequence[float], atmosphere: float, valid_for: float
    ) -> tuple[bytes, int | None]:
        """Encode one command.

        Args:
            differential: (M,) [Pa]; positive fills the even chamber of the pair.
            atmosphere: [Pa] absolute, to add where the wire wants absolute pressures.
            valid_for: [s] after which a board with a watchdog vents by itself.

        Returns:
            The bytes, and the number that the board's echo will carry (None: it has no numbers).
        """

    @abstractmethod
    def vent(self, atmosphere: float) -> tuple[bytes, int | None]:
        """Encode the command that opens every chamber to the atmosphere."""

    @abstractmethod
    def decode(self, data: bytes) -> list[Event]:
        """Take the next bytes of the stream and return what became complete. Never raises."""

    @abstractmethod
    def reset(self) -> None:
        """Forget half-received bytes, as after a reconnect."""

    def _check_segments(self, differential: Sequence[float]) -> None:
        """Raise ValueError unless there is one difference a pair of chambers."""
        if 2 * len(differential) != self.chamber_count:
            raise ValueError(
                f"expected {self.chamber_count // 2} differences, got {len(differential)}"
            )


class LineHost(HostProtocol):
    """The driver's end of a protocol whose board sends text lines."""

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self._lines = LineSplitter()
        self._malformed = 0

    def decode(self, data: bytes) -> list[Event]:
        """Return what complete lines say; damaged lines are counted in ``rejected``."""
        events: list[Event] = []
        for _, line in self._lines.feed(data):
            event = self._parse(line)
            if event is None:
                self._malformed += 1
                self.last_damaged = line[:LONGEST_SHOWN]
            else:
                events.append(event)
        self.rejected = self._malformed + self._lines.damaged
        return events

    @abstractmethod
    def _parse(self, line: str) -> Event | None:
        """Return what a line says; None: it is damaged."""

    def reset(self) -> None:
        """Forget a half-received line."""
        self._lines.reset()


@dataclass(frozen=True)
class BoardCommand:
    """A command as the board understood it."""

    kind: str
    """``setpoint``, ``vent``, ``hello`` or another word of the protocol."""
    first_byte: int
    """Place of its first byte in the stream, counted from 0."""
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


class BoardProtocol(ABC):
    """The firmware's end, for emulators and tests of firmware."""

    gauge: ClassVar[bool] = False
    """Whether the wire carries pressures above the atmosphere."""
    pairwise: ClassVar[bool] = False
    """Whether the board reads a pair of pressures as a difference."""

    def __init__(self, chamber_count: int = 4) -> None:
        self.chamber_count = chamber_count
        self.rejected = 0

    def boot(self, atmosphere: float) -> bytes:  # noqa: ARG002 - most boards say nothing
        """Return what the board says after power-up."""
        return b""

    @abstractmethod
    def decode(self, data: bytes) -> list[BoardCommand]:
        """Take the next bytes from the host and return the commands that became complete."""

    @abstractmethod
    def telemetry(self, reading: BoardReading) -> bytes:
        """Return the bytes of one telemetry report."""

    def reply(self, command: BoardCommand, reading: BoardReading) -> bytes:  # noqa: ARG002
        """Return what the board answers to a command at once."""
        return b""

    def expired(self) -> bytes:
        """Return what the board says when it has vented since no setpoint came in time."""
        return b""
