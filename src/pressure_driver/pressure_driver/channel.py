"""What passes between the node and the process of the port, or the terminal in the node's place.

Messages are JSON lists that begin with a word. From the node: ``setpoint``, ``arm``, ``vent``,
``alive``, ``end``. To the node:

=============== ==============================================================================
``port``        vent command (hexadecimal); if the port was opened, its descriptor comes along
``lost``        the port is gone
``failed``      the port cannot be opened: a sentence
``state``       the state at each tick, bytes sent, bytes received
``diagnostics`` level, sentence, values
``log``         sentence, whether it is a warning
``answer``      to ``arm`` and ``vent``: whether it was done, a sentence
``alive``       nothing else was to be said
``ended``       after ``end``: what is left to be done about the limb; empty if it is vented
=============== ==============================================================================
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import socket
import sys
import time
from collections import deque
from typing import Any

from pressure_driver.safety import Mode


class Channel:
    """One end of the socket between the node and the process of the port; it never waits to send.

    Args:
        end: of a socket pair that keeps the bounds of messages (SOCK_SEQPACKET).
    """

    def __init__(self, end: socket.socket) -> None:
        self.socket = end

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return self.socket.fileno()

    def send(self, *message: Any, descriptor: int | None = None) -> None:
        """Send a message, or drop it if the other end has gone or does not read."""
        descriptors = [] if descriptor is None else [descriptor]
        data = [json.dumps(message).encode()]
        with contextlib.suppress(OSError):
            socket.send_fds(self.socket, data, descriptors, socket.MSG_DONTWAIT)

    def receive(self) -> tuple[list[Any], int | None]:
        """Return the next message and the descriptor that came along, if any.

        Raises:
            EOFError: the other end has gone.
            BlockingIOError, TimeoutError: there is no message.
        """
        try:
            data, descriptors, _, _ = socket.recv_fds(self.socket, 1 << 16, 1)
        except ConnectionError:
            data, descriptors = b"", []
        if not data:
            raise EOFError
        return json.loads(data), descriptors[0] if descriptors else None


class Terminal:
    """Takes the place of the node when the process is started by hand."""

    def __init__(self) -> None:
        self._lines: deque[str] = deque()
        self._shown_at = 0.0

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return sys.stdin.fileno()

    def send(self, word: str, *content: Any, descriptor: int | None = None) -> None:  # noqa: ARG002
        """Print a message; the state once a second."""
        if word == "state" and time.monotonic() - self._shown_at >= 1.0:
            self._shown_at = time.monotonic()
            state = content[0]
            measured = [round(value, 0) for value in state["measured_chamber"]]
            commanded = state["commanded_differential"]
            mode = Mode(state["mode"]).name
            print(mode, "commanded", commanded, "measured", measured, flush=True)
        elif word in ("log", "answer", "failed", "ended"):
            print(content[1] if word == "answer" else content[0], flush=True)

    def receive(self) -> tuple[list[Any], int | None]:
        """Return the next line as a message; the end of the lines ends the process.

        Raises:
            BlockingIOError: there is no line.
        """
        if not self._lines:
            if not select.select([self], [], [], 0.0)[0]:
                raise BlockingIOError
            text = os.read(self.fileno(), 4096).decode()
            self._lines += text.splitlines() if text else ["end"]
        words = self._lines.popleft().split() or ["alive"]
        with contextlib.suppress(ValueError):
            return ["setpoint", 0, [float(word) for word in words], "", 0, 0, "", 0, True], None
        return words[:1], None
