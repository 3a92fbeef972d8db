"""The languages of valve boards: what the driver's end of each offers.

Decoders take any split of the byte stream, throw nothing, and count what they had to reject.
Pressures are in Pa on this side of a protocol, whatever unit the wire carries. The boards' own ends
are those of the emulator.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

NAMES = ("ezloop", "ctrlp", "native", "festo", "pneudrive")
"""The protocols that can be chosen, which are the names of their modules."""
STANDARD_ATMOSPHERE = 101_325.0
"""[Pa]"""
USUAL_LIMIT = 24_000.0
"""[Pa] The default of `pressure_limit`, to which other pressures are in proportion."""
LONGEST_LINE = 512
"""[bytes] A longer line is garbage: its bytes are dropped up to the next line end."""
LONGEST_SHOWN = 80
"""[characters] of a damaged line that are kept to be shown."""


class SettingError(ValueError):
    """A parameter has a value that the driver cannot work with; the message names both."""


def order_of(text: str, count: int) -> tuple[int, ...]:
    """Return the numbers (count,), counted from 0, of a parameter `wiring`.

    Args:
        text: each number from 1 on once; empty: in order.
        count: of them.

    Raises:
        SettingError: it does not name each of them once.
    """
    usual = [str(1 + k) for k in range(count)]
    named = text.replace(",", " ").split() or usual
    if sorted(named) != sorted(usual):
        raise SettingError(
            f"parameter 'wiring' is '{text}': name each of {', '.join(usual)} once, in any order"
        )
    return tuple(int(number) - 1 for number in named)


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
class BoardFailure:
    """The board says that it is in trouble, or that it has vented on its own."""

    text: str


@dataclass(frozen=True)
class BoardReset:
    """The board has started again: it is vented and has forgotten its settings."""

    sign: str
    """From what this is concluded; of a few fixed texts."""


@dataclass(frozen=True)
class BoardText:
    """Free text of the board: boot messages, warnings, commands that it refuses."""

    text: str


@dataclass(frozen=True)
class BoardIdentity:
    """What the board says of itself when asked."""

    chamber_count: int
    largest_pressure: float
    """[Pa] gauge."""
    firmware: str


Event = Telemetry | Echo | BoardFailure | BoardReset | BoardText | BoardIdentity


class FrameBuffer(ABC):
    """Bytes that are cut into frames or lines, and how often some were thrown away."""

    def __init__(self) -> None:
        self.rejected = 0
        """Places at which bytes had to be skipped, and frames or lines that were damaged."""
        self.position = 0
        """Of the first byte that is kept, in the stream."""
        self.kept = bytearray()

    @abstractmethod
    def feed(self, data: bytes) -> list[tuple[int, Any]]:
        """Return (place of the first byte, frame) of what became complete; None for damage."""

    def take(self, count: int) -> bytes:
        """Return the first bytes and forget them."""
        taken = bytes(self.kept[:count])
        del self.kept[:count]
        self.position += len(taken)
        return taken

    def skip_to(self, begin: int) -> None:
        """Skip bytes that are no frame, up to a place or, if it is not behind them, all of them."""
        self.rejected += 1
        self.take(begin if begin > 0 else len(self.kept))

    def reset(self) -> None:
        """Forget a half-received frame."""
        self.take(len(self.kept))


class StreamCutter(FrameBuffer):
    """Cuts a stream into pieces at the byte that ends each of them.

    Args:
        end: the byte after each piece.
        longest: bytes; of a longer piece everything up to its end is dropped.
    """

    def __init__(self, end: bytes, longest: int) -> None:
        super().__init__()
        self._end = end
        self._longest = longest

    def feed(self, data: bytes) -> list[tuple[int, Any]]:
        """Return (place of the first byte, bytes without their end); None for too many."""
        pieces: list[tuple[int, bytes | None]] = []
        self.kept += data
        while (end := self.kept.find(self._end)) >= 0:
            place, piece = self.position, self.take(end + 1)[:-1]
            pieces.append((place, piece if end <= self._longest else None))
        # One byte more than allowed is enough to know later that there were too many.
        self.take(max(len(self.kept) - self._longest - 1, 0))
        return pieces


class LineSplitter(StreamCutter):
    """Collects bytes and returns complete lines with the place of their first byte.

    Lines end with a line feed; carriage returns and blanks at either end are dropped, and so are
    empty lines. Bytes outside printable ASCII (and tab) make a line damaged.
    """

    def __init__(self) -> None:
        super().__init__(b"\n", LONGEST_LINE)

    def feed(self, data: bytes) -> list[tuple[int, str | None]]:
        """Return (place of the first byte, text) of the complete lines; None for a damaged one."""
        lines: list[tuple[int, str | None]] = []
        for start, raw in super().feed(data):
            text = (raw or b"").strip()
            if raw is None or any(byte != 9 and not 32 <= byte < 127 for byte in text):
                lines.append((start, None))
            elif text:
                lines.append((start + len(raw) - len(raw.lstrip()), text.decode("ascii")))
        return lines


class HostProtocol(ABC):
    """The driver's end: encodes commands, decodes what the board says.

    Args:
        chamber_count: 2M, at most 32.
        frames: cuts what the board sends.
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
    reach: float = 1e6
    """[Pa] gauge, the largest that its numbers can command."""
    resolution: float = 0.0
    """[Pa] of one step of its readings, where that is coarser than their noise."""
    clock: Callable[[], float]
    """[s] steady."""
    room: Callable[[], float]
    """[Pa] absolute, of the atmosphere, where the wire wants absolute pressures."""

    def __init__(self, chamber_count: int, frames: FrameBuffer) -> None:
        self.chamber_count = chamber_count
        self._frames = frames
        self.clock, self.room = time.monotonic, lambda: STANDARD_ATMOSPHERE
        self.last_damaged = ""
        """The newest of them, where the protocol has lines."""
        self.unsettled = ""
        """Why no pressure may be commanded yet, though the board talks; empty if it may."""
        self._follow_up = b""
        self._number = 0

    @property
    def rejected(self) -> int:
        """Frames or lines that were damaged and thrown away."""
        return self._frames.rejected

    def configure(self, settings: Settings) -> None:  # noqa: B027 - most boards have no parameters
        """Take over the parameters that are for this board alone."""

    def doubt(self) -> None:  # noqa: B027 - most boards have no settings
        """Trust no setting of the board any more, as after it has been silent."""

    @abstractmethod
    def start(self) -> bytes:
        """Return what a board must be sent after the port has opened."""

    @abstractmethod
    def setpoint(self, gauge: Sequence[float]) -> tuple[bytes, int | None]:
        """Encode one command.

        Args:
            gauge: (2M,) [Pa] of each valve, within the driver's limits.

        Returns:
            The bytes, and the number that the board's echo will carry (None: it has no numbers).
        """

    def vent(self) -> tuple[bytes, int | None]:
        """Encode the command that opens every chamber to the atmosphere, or regulates to it."""
        return self.setpoint([0.0] * self.chamber_count)

    def emergency(self) -> bytes:
        """Return what empties a board in any state, for a process that knows nothing about it.

        It is complete after any half-sent bytes.
        """
        return self.separator + self.vent()[0]

    def _next(self) -> int:
        """Return the number of the next frame, modulo 65536, for protocols that have numbers."""
        self._number = (self._number + 1) & 0xFFFF
        return self._number

    def follow_up(self) -> bytes:
        """Return what is to be sent at once because of what has been decoded."""
        data, self._follow_up = self._follow_up, b""
        return data

    def decode(self, data: bytes) -> list[Event]:
        """Take the next bytes of the stream and return what became complete. Never raises."""
        events: list[Event] = []
        for _, frame in self._frames.feed(data):
            found = [] if frame is None else self._interpret(frame)
            self._frames.rejected += not found
            events += found
        return events

    @abstractmethod
    def _interpret(self, frame: Any) -> list[Event]:
        """Return what a frame or a line says; nothing: it is damaged."""

    def reset(self) -> None:
        """Forget half-received bytes and what the board has said, as after a reconnect."""
        self._frames.reset()


class LineHost(HostProtocol):
    """The driver's end of a protocol whose board sends text lines."""

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count, LineSplitter())

    def _interpret(self, line: str) -> list[Event]:
        event = self._parse(line)
        if event is None:
            self.last_damaged = line[:LONGEST_SHOWN]
            return []
        return [event]

    @abstractmethod
    def _parse(self, line: str) -> Event | None:
        """Return what a line says; None: it is damaged."""


def host_protocol(
    name: str, chamber_count: int = 4, settings: Settings | None = None
) -> HostProtocol:
    """Return the driver's end of one of the `NAMES`; only its module is loaded."""
    module = import_module(f"pressure_driver.protocols.{name}")
    host: Callable[[int], HostProtocol] = getattr(module, f"{name.capitalize()}Host")
    protocol = host(chamber_count)
    if settings is not None:
        protocol.configure(settings)
    return protocol
