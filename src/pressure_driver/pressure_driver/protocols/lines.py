"""Text lines: cut a byte stream into them, whatever garbage is in it, and decode what they say."""

from __future__ import annotations

from abc import abstractmethod

from pressure_driver.protocols.base import Event, HostProtocol
from pressure_driver.protocols.pieces import StreamCutter

LONGEST_LINE = 512
"""[bytes] A longer line is garbage: its bytes are dropped up to the next line end."""

LONGEST_SHOWN = 80
"""[characters] of a damaged line that is kept to be shown."""


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
