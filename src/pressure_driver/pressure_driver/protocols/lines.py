"""Cut a byte stream into text lines, whatever garbage is in it."""

from __future__ import annotations

LONGEST_LINE = 512
"""[bytes] A longer line is garbage: its bytes are dropped up to the next line end."""


class LineSplitter:
    """Collects bytes and returns complete lines with the place of their first byte.

    Lines end with a line feed; carriage returns and blanks at either end are dropped, and so are
    empty lines. Bytes outside printable ASCII (and tab) make a line damaged.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._position = 0
        self._overlong = False
        self.damaged = 0

    def feed(self, data: bytes) -> list[tuple[int, str]]:
        """Return the lines completed by ``data`` as (place of the first byte, text)."""
        lines: list[tuple[int, str]] = []
        self._buffer += data
        while (end := self._buffer.find(b"\n")) >= 0:
            raw = bytes(self._buffer[:end])
            start = self._position
            del self._buffer[: end + 1]
            self._position += end + 1
            if self._overlong or len(raw) > LONGEST_LINE:
                self._overlong = False
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
        if len(self._buffer) > LONGEST_LINE:
            self._position += len(self._buffer)
            self._buffer.clear()
            self._overlong = True
        return lines

    def reset(self) -> None:
        """Forget a half-received line."""
        self._position += len(self._buffer)
        self._buffer.clear()
        self._overlong = False
