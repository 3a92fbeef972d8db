"""The node's end of the process of the port: it starts it, talks with it, and vents if it dies.

Messages are JSON lists that begin with a word. From the node: ``setpoint``, ``arm``, ``vent``,
``lease``, ``alive``, ``end``. To the node:

=========== ==================================================================================
``port``    the line is open, with the descriptor of a serial port
``lost``    the port is gone
``failed``  the port cannot be opened: the number of the error or null, its text
``state``   the state at each tick, by names
``log``     sentence, whether it is a warning
``answer``  to ``arm`` and ``vent``: whether it was done, a sentence
``alive``   nothing else was to be said
``ended``   after ``end``: what is left to be done about the limb; empty if it is vented
=========== ==================================================================================
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import queue
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from serial.tools import list_ports

from pressure_driver import lines
from pressure_driver.lines import Channel, is_tcp, tcp_address
from pressure_driver.protocols import host_protocol
from pressure_driver.settings import Settings

STABLE_NAMES = Path("/dev/serial/by-id")
"""Where the system keeps names of ports that survive re-plugging."""
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


class PortError(RuntimeError):
    """The line to the board cannot be used; the message names it, the cause and the remedy."""


def available_ports() -> list[str]:
    """Return the serial ports of this machine, by their stable names where there are any."""
    by_id = sorted(map(str, STABLE_NAMES.glob("*")))
    known = {os.path.realpath(path) for path in by_id}
    others = [port.device for port in list_ports.comports() if port.device not in known]
    links = [path for path in Path("/tmp").glob("der_limb_board_*") if path.is_symlink()]
    return by_id + sorted(others) + sorted(map(str, links))


def stable_name(port: str) -> str:
    """Return the by-id name of a serial port, which survives re-plugging, or a host's number.

    A name that nobody knows is returned as it is.
    """
    if is_tcp(port):
        with contextlib.suppress(OSError):
            host, number = tcp_address(port)
            return f"tcp://{socket.gethostbyname(host)}:{number}"
        return port
    for path in sorted(STABLE_NAMES.glob("*")):
        if os.path.realpath(path) == os.path.realpath(port):
            return str(path)
    return port


def explain(port: str, error: OSError) -> str:
    """Return a sentence with the cause and the remedy of a port that does not open."""
    number = error.errno
    if is_tcp(port):
        return _explain_connection(port, error)
    ports = ", ".join(available_ports()) or "none"
    if not Path(port).exists() or number == errno.ENOENT:
        return (
            f"no serial device {port}; ports that exist: {ports}. Plug the board in, or set the "
            "parameter 'port'"
        )
    if number in lines.IN_USE:
        return (
            f"serial port {port} is in use by another program; find it with 'fuser -v {port}', "
            f"close it, or set the parameter 'port' (ports that exist: {ports})"
        )
    if number in (errno.EISDIR, errno.ENOTTY, errno.EINVAL) or "ioctl" in str(error):
        return f"{port} is no serial port; ports that exist: {ports}: set the parameter 'port'"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission to open {port}: sudo usermod -a -G dialout $USER, then log in again"
    return f"cannot open serial port {port}: {error}; ports that exist: {ports}"


def _explain_connection(port: str, error: OSError) -> str:
    if error.errno in lines.IN_USE:
        return f"another program of this computer has the board at {port}: end it"
    if error.errno == errno.EINVAL or (error.errno or 0) < 0:  # of the look-up of a name
        return f"{port}: {error.strerror}; set the parameter 'port'"
    return (
        f"no board answers at {port} ({error}): look at its power, its cable and whether this "
        "computer has an address in its network, or set the parameter 'port'"
    )


class PortProcess:
    """One process of `pressure_driver.board`, and what it has said.

    Args:
        settings: the parameters.
        on_message: is called when something has come, from a thread.
    """

    def __init__(self, settings: Settings, on_message: Callable[[], None]) -> None:
        self.states: deque[dict[str, Any]] = deque(maxlen=100)
        """State by names, of each tick, until they are taken."""
        self.log: deque[tuple[str, bool]] = deque(maxlen=200)
        """Sentences for the log, and whether they are warnings, until they are taken."""
        self.error = ""
        """Why the process is gone, and whether the board was vented; empty before."""
        self._settings = replace(settings, port=stable_name(settings.port))
        self._on_message = on_message
        self._answers: queue.Queue[tuple[bool, str]] = queue.Queue()
        self.protocol = host_protocol(settings)
        """What the board understands."""
        self._descriptor = -1
        self._outcome: str | None = None
        self._ending = False
        self._thread = threading.Thread(target=self._listen, name="port process", daemon=True)

    def start(self) -> None:
        """Start the process and wait until it has opened the port.

        Raises:
            PortError: the port cannot be opened.
        """
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process = subprocess.Popen(
            [
                *(sys.executable, "-m", "pressure_driver.board"),
                *(str(far.fileno()), json.dumps(vars(self._settings))),
            ],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            pass_fds=(far.fileno(),),
            start_new_session=True,
            # Nothing of the working folder is imported.
            env={**os.environ, "PYTHONSAFEPATH": "1"},
        )
        far.close()
        self.process_id = self._process.pid
        self._channel = Channel(near)
        near.settimeout(START_TIME)
        try:
            message, descriptor = self._channel.receive()
        except (EOFError, TimeoutError) as error:
            self._process.kill()
            raise PortError("the process of the port does not start") from error
        if message[0] == "failed":
            self._process.wait()
            raise PortError(explain(self._settings.port, OSError(*message[1:])))
        self._serve(message, descriptor)
        near.settimeout(LOOK)
        self._thread.start()

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
            return self._answers.get(timeout=0.0 if self.error else ANSWER_TIME)
        return False, self.error or "the process of the port does not answer"

    def close(self) -> str:
        """End the process in order; return what is left to be done about the limb, or nothing."""
        self._ending = True
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
            command = self.protocol.emergency()
            if is_tcp(self._settings.port):
                problem = lines.vent_anew(self._settings.port, command, lines.VENT_TIME)
            else:
                problem = lines.vent_line(self._descriptor, command, lines.VENT_TIME)
            told = f"the vent command was sent for {lines.VENT_TIME:g} s; see that it has vented"
            self.error = f"{reason}: {problem or told}"
        elif not self._ending:
            left = self._outcome or "the board is vented"
            self.error = f"the process of the port was ended by somebody else: {left}"
        lines.release_descriptor(self._descriptor)
        self._on_message()

    def _serve(self, message: list[Any], descriptor: int | None) -> None:
        word, *content = message
        if word in ("port", "lost"):
            if self._descriptor >= 0:
                os.close(self._descriptor)
            self._descriptor = -1 if descriptor is None else descriptor
        if word == "state":
            self.states.append(content[0])
        elif word == "log":
            self.log.append((content[0], content[1]))
        elif word == "answer":
            self._answers.put((content[0], content[1]))
        elif word == "ended":
            self._outcome = content[0]
        if word in ("state", "log"):
            self._on_message()
