"""The languages of valve boards: what the driver's end of each offers.

Decoders take any split of the byte stream, throw nothing, and count what they had to reject.
Pressures are in Pa on this side of a protocol, whatever unit the wire carries. The boards' own ends
are those of the emulator.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
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


def cut_at(end: bytes, longest: int, kept: bytearray) -> list[bytes | None]:
    """Take the pieces of a stream that are complete.

    Args:
        end: the byte after each piece.
        longest: bytes; a longer piece counts as damaged, and its bytes are not kept.
        kept: what has come and is not taken yet; an unfinished piece stays there.

    Returns:
        The pieces without their ends; None for a damaged one.
    """
    *pieces, rest = kept.split(end)
    # One byte more than allowed is enough to know later that there were too many.
    kept[:] = rest[-longest - 1 :]
    return [bytes(piece) if len(piece) <= longest else None for piece in pieces]


def skip_to(begin: int, kept: bytearray) -> None:
    """Drop bytes that are no frame, up to a place or, if it is not behind them, all of them."""
    del kept[: begin if begin > 0 else len(kept)]


def cut_lines(kept: bytearray) -> Iterator[str | None]:
    """Take the lines that are complete; None for a damaged one.

    Lines end with a line feed; carriage returns and blanks at either end are dropped, and so are
    empty lines. Bytes outside printable ASCII (and tab) make a line damaged.
    """
    for raw in cut_at(b"\n", LONGEST_LINE, kept):
        text = (raw or b"").strip()
        if raw is None or any(byte != 9 and not 32 <= byte < 127 for byte in text):
            yield None
        elif text:
            yield text.decode("ascii")


class ProtocolEnd(ABC):
    """One end of a language: what it hears is cut into frames or lines, and interpreted.

    Args:
        chamber_count: 2M, at most 32.
    """

    def __init__(self, chamber_count: int = 4) -> None:
        self.chamber_count = chamber_count
        self.rejected = 0
        """Frames or lines that were damaged, and places at which bytes had to be skipped."""
        self._kept = bytearray()
        """Bytes of what is not complete yet."""
        self.number: int | None = None
        """Of the newest frame to the other end; None where frames have no numbers."""

    def configure(self, settings: Any) -> None:  # noqa: B027 - most boards have no parameters
        """Take over the parameters that are for this board alone."""

    def decode(self, data: bytes) -> list[Any]:
        """Take the next bytes of the stream; return what complete frames say. Never raises."""
        self._kept += data
        said: list[Any] = []
        for frame in self._cut():
            found = [] if frame is None else self._interpret(frame)
            self.rejected += not found
            said += found
        return said

    def _next(self) -> int:
        """Return the number of the next frame, modulo 65536."""
        self.number = ((self.number or 0) + 1) & 0xFFFF
        return self.number

    @abstractmethod
    def _cut(self) -> Iterable[Any]:
        """Take what is complete from the bytes that are kept; None for damage."""

    @abstractmethod
    def _interpret(self, frame: Any) -> list[Any]:
        """Return what a frame or a line says; nothing: it is damaged."""


class HostProtocol(ProtocolEnd):
    """The driver's end: encodes commands, decodes what the board says: each an `Event`."""

    name: ClassVar[str]
    baud_rate: ClassVar[int] = 115200
    weaknesses: ClassVar[tuple[str, ...]] = ()
    """What the protocol cannot protect from; shown in the diagnostics."""
    reports_supply: ClassVar[bool] = False
    has_watchdog: ClassVar[bool] = False
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

    def __init__(self, chamber_count: int = 4) -> None:
        super().__init__(chamber_count)
        self.clock, self.room = time.monotonic, lambda: STANDARD_ATMOSPHERE
        self.last_damaged = ""
        """The newest damaged line, where the protocol has lines."""
        self.unsettled = ""
        """Why no pressure may be commanded yet, though the board talks; empty if it may."""
        self._follow_up = b""
        self.reset()

    def doubt(self) -> None:
        """Trust no setting of the board any more, as after it has been silent."""

    @abstractmethod
    def start(self) -> bytes:
        """Return what a board must be sent after the port has opened."""

    @abstractmethod
    def setpoint(self, gauge: Sequence[float]) -> bytes:
        """Encode one command.

        Args:
            gauge: (2M,) [Pa] of each valve, within the driver's limits.
        """

    def vent(self) -> bytes:
        """Encode the command that opens every chamber to the atmosphere, or regulates to it."""
        return self.setpoint([0.0] * self.chamber_count)

    def emergency(self) -> bytes:
        """Return what empties a board in any state, for a process that knows nothing about it.

        It is complete after any half-sent bytes.
        """
        return self.separator + self.vent()

    def follow_up(self) -> bytes:
        """Return what is to be sent at once because of what has been decoded."""
        data, self._follow_up = self._follow_up, b""
        return data

    def reset(self) -> None:
        """Forget half-received bytes and what the board has said, as after a reconnect."""
        self._kept.clear()


class LineHost(HostProtocol):
    """The driver's end of a protocol whose board sends text lines."""

    def _cut(self) -> Iterator[str | None]:
        return cut_lines(self._kept)

    def _interpret(self, line: str) -> list[Event]:
        event = self._parse(line)
        if event is None:
            self.last_damaged = line[:LONGEST_SHOWN]
            return []
        return [event]

    @abstractmethod
    def _parse(self, line: str) -> Event | None:
        """Return what a line says; None: it is damaged."""


def host_protocol(settings: Settings) -> HostProtocol:
    """Return the driver's end of the language that is chosen; only its module is loaded."""
    module = import_module(f"pressure_driver.protocols.{settings.protocol}")
    host: type[HostProtocol] = getattr(module, f"{settings.protocol.capitalize()}Host")
    protocol = host(2 * settings.segment_count)
    protocol.configure(settings)
    return protocol
