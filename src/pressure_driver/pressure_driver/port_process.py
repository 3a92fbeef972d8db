"""The port and its process: the serial line, the socket to the node, and the node's end of it.

The node starts the process, talks with it, and vents if it dies.

Messages are JSON lists that begin with a word. From the node: ``setpoint``, ``arm``, ``vent``,
``lease``, ``alive``, ``end``. To the node:

=========== ==================================================================================
``port``    the port has been opened: vent command (hexadecimal), with the port's descriptor
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
import fcntl
import json
import os
import queue
import socket
import struct
import subprocess
import sys
import termios
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

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
RELEASE_TIME = 4.0
"""[s] in which a process that vents after the end of its driver has let go of the port."""
VENT_TIME = 1.0
"""[s] for which one process of the driver vents in the place of the other."""
VENT_PERIOD = 0.05
"""[s] between two of its vent commands."""
ADVICE = "close the air supply"
IN_USE = (errno.EAGAIN, errno.EBUSY)
"""Error numbers of a port that another program has."""


class PortError(RuntimeError):
    """The serial port cannot be used; the message names it, the cause and the remedy."""


def available_ports() -> list[str]:
    """Return the serial ports of this machine, by their stable names where there are any."""
    by_id = sorted(map(str, STABLE_NAMES.iterdir())) if STABLE_NAMES.is_dir() else []
    known = {os.path.realpath(path) for path in by_id}
    others = [port.device for port in list_ports.comports() if port.device not in known]
    links = [path for path in Path("/tmp").glob("der_limb_board_*") if path.is_symlink()]
    return by_id + sorted(others) + sorted(map(str, links))


def stable_name(port: str) -> str:
    """Return the by-id name of a port, which survives re-plugging, or the name itself."""
    if STABLE_NAMES.is_dir():
        for path in sorted(STABLE_NAMES.iterdir()):
            if os.path.realpath(path) == os.path.realpath(port):
                return str(path)
    return port


def explain(port: str, error: OSError) -> str:
    """Return a sentence with the cause and the remedy of a port that does not open."""
    number = error.errno
    ports = ", ".join(available_ports()) or "none"
    if not Path(port).exists() or number == errno.ENOENT:
        return (
            f"no serial device {port}; ports that exist: {ports}. Plug the board in, or set the "
            "parameter 'port'"
        )
    if number in IN_USE:
        return (
            f"serial port {port} is in use by another program; find it with 'fuser -v {port}', "
            f"close it, or set the parameter 'port' (ports that exist: {ports})"
        )
    if number in (errno.EISDIR, errno.ENOTTY, errno.EINVAL) or "ioctl" in str(error):
        return f"{port} is no serial port; ports that exist: {ports}: set the parameter 'port'"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission to open {port}: sudo usermod -a -G dialout $USER, then log in again"
    return f"cannot open serial port {port}: {error}; ports that exist: {ports}"


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


def open_port(port: str, baud_rate: int, patience: float = 0.0) -> serial.Serial:
    """Open a serial port for this program alone.

    Args:
        port: its path.
        baud_rate: [baud].
        patience: [s] to wait for another program to leave it.

    Raises:
        OSError, ValueError: it does not exist, is in use, or may not be opened.
    """
    deadline = time.monotonic() + patience
    while True:
        try:
            device = serial.Serial(port, baud_rate, timeout=0, write_timeout=0.05, exclusive=True)
            break
        except OSError as error:
            if error.errno not in IN_USE or time.monotonic() >= deadline:
                raise
        time.sleep(0.1)
    with contextlib.suppress(OSError):
        fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
    return device


def release_port(device: serial.Serial, drop: bool = True) -> None:
    """Close a port without waiting for the board.

    The lock is taken off by name: another descriptor of the same port may live a little longer.

    Args:
        device: the port.
        drop: throw away what waits in its output queue, for which the kernel would wait. Not after
            the last words: a board on a pseudo-terminal may not have read them yet.
    """
    if drop:
        with contextlib.suppress(Exception):
            device.reset_output_buffer()
    with contextlib.suppress(Exception):
        release_descriptor(os.dup(device.fileno()))
    with contextlib.suppress(Exception):
        device.close()


def vent_port(descriptor: int, command: bytes, duration: float) -> str:
    """Send the vent command again and again, before all that waits to be sent.

    Args:
        descriptor: of the open port; −1 if there is none.
        command: opens every chamber, complete after any half-sent bytes.
        duration: [s] for which it is repeated: bytes may be damaged.

    Returns:
        What is left to be done, or nothing if the last command has left.
    """
    if descriptor < 0:
        return f"the board cannot be reached: {ADVICE}"
    taken, end = False, time.monotonic() + duration
    try:
        termios.tcflush(descriptor, termios.TCOFLUSH)
        while time.monotonic() < end:
            try:
                taken = os.write(descriptor, command) == len(command)
            except BlockingIOError:
                taken = False
                termios.tcflush(descriptor, termios.TCOFLUSH)
            time.sleep(VENT_PERIOD)
        (waiting,) = struct.unpack("i", fcntl.ioctl(descriptor, termios.TIOCOUTQ, bytes(4)))
    except (OSError, termios.error) as error:
        return f"the port is gone ({error}): {ADVICE}"
    return "" if taken and not waiting else f"the board takes no bytes: {ADVICE}"


def release_descriptor(descriptor: int) -> None:
    """Close a descriptor of a port, if there is one, and take off the locks of the port."""
    if descriptor < 0:
        return
    with contextlib.suppress(OSError):
        fcntl.ioctl(descriptor, termios.TIOCNXCL)
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_UN)
    with contextlib.suppress(OSError):
        os.close(descriptor)


def prefer_thread(priority: int) -> bool:
    """Give the calling thread real-time priority (SCHED_FIFO): it serves a port.

    Args:
        priority: 1 … 99, 0 to leave the thread as it is.

    Returns:
        Whether it was granted; it needs root, CAP_SYS_NICE or an rtprio limit.
    """
    if priority <= 0:
        return False
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        return True
    return False


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
        """Why the process had to be replaced, and whether the board was vented; empty before."""
        self._settings = replace(settings, port=stable_name(settings.port))
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
            return self._answers.get(timeout=0.0 if self.error else ANSWER_TIME)
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
            problem = vent_port(self._descriptor, self._vent_command, VENT_TIME)
            told = f"the vent command was sent for {VENT_TIME:g} s; see that it has vented"
            self.error = f"{reason}: {problem or told}"
        release_descriptor(self._descriptor)
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
            self.states.append(content[0])
        elif word == "log":
            self.log.append((content[0], content[1]))
        elif word == "answer":
            self._answers.put((content[0], content[1]))
        elif word == "ended":
            self._outcome = content[0]
        if word in ("state", "log"):
            self._on_message()
