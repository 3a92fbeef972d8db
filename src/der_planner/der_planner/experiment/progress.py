"""What people see while an experiment runs: one line a step, a bar on a terminal."""

from __future__ import annotations

import sys
import time


class Progress:
    """Prints steps to stderr; redraws a bar on a terminal, prints it rarely elsewhere."""

    def __init__(self) -> None:
        self._terminal = sys.stderr.isatty()
        self._last_shown = -1e9
        self._open_line = False

    def say(self, text: str) -> None:
        """Print one line."""
        self._end_bar()
        print(text, file=sys.stderr, flush=True)

    def bar(self, done: float, total: float, text: str, unit: str = "s") -> None:
        """Show that ``done`` of ``total`` seconds, or of another unit, are over."""
        now = time.monotonic()
        finished = done >= total
        if now - self._last_shown < (0.2 if self._terminal else 15.0) and not finished:
            return
        self._last_shown = -1e9 if finished else now
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
        line = f"  [{'#' * int(30 * share):<30}] {max(done, 0.0):5.0f} / {total:.0f} {unit} {text}"
        if self._terminal:
            print(f"\r{line:<100}", end="", file=sys.stderr, flush=True)
            self._open_line = True
            if finished:
                self._end_bar()
        else:
            print(line, file=sys.stderr, flush=True)

    def _end_bar(self) -> None:
        if self._open_line:
            print(file=sys.stderr)
            self._open_line = False
