"""Waiting for what other threads and processes do, and a clock that a test moves by hand."""

from __future__ import annotations

import time
from collections.abc import Callable


def wait_for(condition: Callable[[], object], what: str, limit: float = 60.0) -> None:
    """Return once a condition holds; fail if it does not within a limit [s]."""
    deadline = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < deadline, f"waited too long for {what}"
        time.sleep(0.005)


class Clock:
    """Tells ``now``."""

    def __init__(self, now: float = 100.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now
