"""What passes between the node and the process of the port, and the node's end of it.

Messages are JSON lists that begin with a word. From the node: ``setpoint``, ``arm``, ``vent``,
``alive``, ``end``. To the node:

=============== ==============================================================================
``port``        the port has been opened: vent command (hexadecimal), with the port's descriptor
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
import queue
import select
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any

from pressure_driver import ports
from pressure_driver.safety import Mode
from pressure_driver.settings import Settings, to_options

LOOK = 0.05
"""[s] that one look for a message lasts; the process says something every 0.03 s."""
MOST_LOOKS = 20
"""Looks in a row without a message, after which the process counts as dead. Looks are counted and
not seconds: a machine that stands still stops both. One core may stand still for half a second."""
START_TIME = 20.0
"""[s] for the process to start and open the port; a port in use is waited for."""
ANSWER_TIME = 1.0
"""[s] for an answer to `arm` or `vent`."""
END_TIME = 6.0
"""[s] for the process to vent, see that the board obeys, and end."""


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


class PortProcess:
    """One process of `pressure_driver.board`, and what it has said.

    Args:
        settings: the parameters.
        on_message: is called when something has come, from a thread.
    """

    def __init__(self, settings: Settings, on_message: Callable[[], None]) -> None:
        self.states: deque[tuple[dict[str, Any], int, int]] = deque(maxlen=100)
        """State by names, bytes sent, bytes received: of each tick, until they are taken."""
        self.log: deque[tuple[str, bool]] = deque(maxlen=200)
        """Sentences for the log, and whether they are warnings, until they are taken."""
        self.diagnostics: tuple[str, str, dict[str, Any]] = ("stale", "starting", {})
        """Level, sentence and values."""
        self.error = ""
        """Why the process had to be replaced, and whether the board was vented; empty before."""
        self._settings = settings
        self._on_message = on_message
        self._answers: queue.Queue[tuple[bool, str]] = queue.Queue()
        self._vent_command = b""
        self._descriptor = -1
        self._outcome: str | None = None
        self._thread = threading.Thread(target=self._listen, name="port process", daemon=True)

    def start(self) -> None:
        """Start the process and wait until it has opened the port.

        Raises:
            PortError: the port cannot be opened.
        """
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process = subprocess.Popen(
            [
                *(sys.executable, "-m", "pressure_driver.board", f"--socket={far.fileno()}"),
                *to_options(self._settings),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=(far.fileno(),),
            start_new_session=True,
            # Nothing of the working folder is imported.
            env={**os.environ, "PYTHONSAFEPATH": "1"},
        )
        far.close()
        self._channel = Channel(near)
        near.settimeout(START_TIME)
        try:
            message, descriptor = self._channel.receive()
        except (EOFError, TimeoutError) as error:
            self._process.kill()
            raise ports.PortError("the process of the port does not start") from error
        if message[0] == "failed":
            self._process.wait()
            raise ports.PortError(message[1])
        self._serve(message, descriptor)
        near.settimeout(LOOK)
        self._thread.start()

    @property
    def process_id(self) -> int:
        """Of the process."""
        return self._process.pid

    # ---------------------------------------------------------------------------- requests

    def send(self, *message: Any) -> None:
        """Send a message of `pressure_driver.board`."""
        self._channel.send(*message)

    def ask(self, word: str) -> tuple[bool, str]:
        """Return the answer to ``arm`` or ``vent``: whether it was done, and a sentence."""
        while not self._answers.empty():
            self._answers.get_nowait()  # it came too late for whoever asked
        self.send(word)
        with contextlib.suppress(queue.Empty):
            return self._answers.get(timeout=ANSWER_TIME)
        return False, self.error or "the process of the port does not answer: it is replaced"

    def close(self) -> str:
        """End the process in order; return what is left to be done about the limb, or nothing."""
        self.send("end")
        self._thread.join(END_TIME)
        if self._thread.is_alive():
            self._process.kill()  # the thread then vents
            self._thread.join(END_TIME)
        return self.error or self._outcome or ""

    # --------------------------------------------------------------------------- in the thread

    def _listen(self) -> None:
        """Serve messages until the process has ended; if it was not to end, vent for it."""
        silent_looks = 0
        reason = "the process of the port has ended"
        while self._outcome is None:
            try:
                message, descriptor = self._channel.receive()
            except TimeoutError:
                silent_looks += 1
                if silent_looks == MOST_LOOKS:
                    reason = f"no sign of life of the port's process for {LOOK * MOST_LOOKS:g} s"
                    break
                continue
            except EOFError:
                break
            silent_looks = 0
            self._serve(message, descriptor)
        if self._outcome is None:
            self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(LOOK)
        if self._outcome is None:
            problem = ports.vent_port(self._descriptor, self._vent_command, ports.VENT_TIME)
            told = f"the vent command was sent for {ports.VENT_TIME:g} s; see that it has vented"
            self.error = f"{reason}: {problem or told}"
        ports.release_descriptor(self._descriptor)
        self._on_message()

    def _serve(self, message: list[Any], descriptor: int | None) -> None:
        word, *content = message
        if word in ("port", "lost"):
            if self._descriptor >= 0:
                os.close(self._descriptor)
            self._descriptor = -1 if descriptor is None else descriptor
        if word == "port":
            self._vent_command = bytes.fromhex(content[0])
        elif word == "state":
            self.states.append((content[0], content[1], content[2]))
        elif word == "log":
            self.log.append((content[0], content[1]))
        elif word == "answer":
            self._answers.put((content[0], content[1]))
        elif word == "diagnostics":
            self.diagnostics = (content[0], content[1], content[2])
        elif word == "ended":
            self._outcome = content[0]
        if word in ("state", "log"):
            self._on_message()
