"""One operator commands, everybody else watches."""

from __future__ import annotations

import threading
from collections.abc import Callable

POLICIES = ("continue", "stop", "vent")


class Desk:
    """Who commands the limb.

    A browser window is known by a name that the server gave it. It takes the desk if nobody has it,
    and loses it when it leaves or its connection stays away. A window that is loaded anew gets
    another name in the same tab of its browser, and keeps the desk.

    Args:
        lost: called with the window's name when the operator's connection is lost.
    """

    def __init__(self, lost: Callable[[str], None]) -> None:
        self._lost = lost
        self._lock = threading.Lock()
        self._operator: str | None = None
        self._tabs: dict[str, str] = {}

    @property
    def operator(self) -> str | None:
        """Name of the window that commands; None: nobody does."""
        return self._operator

    def take(self, window: str) -> bool:
        """Take the desk if it is free; tell whether the window now has it."""
        with self._lock:
            if self._operator is None:
                self._operator = window
            return self._operator == window

    def connected(self, window: str, tab: str) -> None:
        """Tell in which tab of a browser a window is: it takes over from an earlier one there."""
        with self._lock:
            if self._operator is not None and self._tabs.get(self._operator) == tab:
                self._operator = window
            self._tabs[window] = tab

    def leave(self, window: str) -> None:
        """Give the desk up on purpose: nothing is lost."""
        with self._lock:
            if self._operator == window:
                self._operator = None

    def disconnected(self, window: str) -> None:
        """Tell that a window has gone without leaving; frees the desk if it had it."""
        with self._lock:
            self._tabs.pop(window, None)
            was_operator = self._operator == window
            if was_operator:
                self._operator = None
        if was_operator:
            self._lost(window)

    def may_command(self, window: str) -> bool:
        """Tell whether a window has the desk."""
        return self._operator == window
