"""Cut a byte stream at the byte that ends a line or a frame."""

from __future__ import annotations


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
