"""The lines of the process of the port: to the board, serial or `tcp://`, and to the node.

The line to the board is a descriptor that the process waits for and never waits in. A serial port
is handed to the driver's node beside the process, which vents through it. A connection is not: what
the process has sent by halves would be in it, so whoever vents opens one of its own.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
import struct
import termios
import time
from typing import Any
from urllib.parse import urlsplit

import serial

RELEASE_TIME = 4.0
"""[s] in which a process that vents after the end of its driver has let go of the port."""
VENT_TIME = 1.0
"""[s] for which one process of the driver vents in the place of the other."""
VENT_PERIOD = 0.05
"""[s] between two vent commands of a process that vents in the place of another."""
CONNECT_TIME = 0.4
"""[s] for a connection: over WLAN some take 0.2 s, and meanwhile nothing runs."""
ADVICE = "close the air supply"
IN_USE = (errno.EAGAIN, errno.EBUSY, errno.EADDRINUSE)
"""Error numbers of a line that another program has."""


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


class Line:
    """An open line to a board: a serial port, or a connection to a board or to what has its port.

    Args:
        port: path of a serial port, or `tcp://host:port`.
        baud_rate: [baud] of a serial port.
        alone: keep other programs of this computer from the same board in a network; the boards
            themselves listen to several hosts at once. A serial port is always kept.

    Attributes:
        shared: the descriptor may be given to another process, which vents through it.

    Raises:
        OSError, ValueError: it does not exist, is in use, or may not be opened; nobody answers.
    """

    def __init__(self, port: str, baud_rate: int = 0, alone: bool = True) -> None:
        self.shared = not is_tcp(port)
        self._device: Any = None
        self._claim = socket.socket(socket.AF_UNIX)
        try:
            if self.shared:
                self._device = serial.Serial(port, baud_rate, timeout=0, exclusive=True)
                with contextlib.suppress(OSError):
                    fcntl.ioctl(self._device.fileno(), termios.TIOCEXCL)
                return
            if alone:
                # A name without a file: the kernel forgets it with the process.
                self._claim.bind(f"\0limb board at {port}")
            self._device = socket.create_connection(tcp_address(port), CONNECT_TIME)
            self._device.setblocking(False)
            # A command is never held back to wait for more.
            self._device.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except (OSError, ValueError):
            self._claim.close()
            raise

    def fileno(self) -> int:
        """Return the descriptor to wait for."""
        return int(self._device.fileno())

    def read(self) -> bytes:
        """Return the bytes that are there.

        Raises:
            OSError: the board has gone.
        """
        if self.shared:
            return bytes(self._device.read(max(self._device.in_waiting, 1)))
        with contextlib.suppress(BlockingIOError):
            data: bytes = self._device.recv(1 << 16)
            if data:
                return data
            raise ConnectionResetError(errno.ECONNRESET, "the board has closed the connection")
        return b""

    def write(self, data: bytes) -> None:
        """Hand bytes to the operating system without waiting.

        Raises:
            OSError: the board has gone, or does not read so that there is no room for them.
        """
        count = 0
        with contextlib.suppress(BlockingIOError):
            # pyserial's own `write` waits for the terminal after each write.
            count = os.write(self.fileno(), data)
        if count < len(data):
            raise OSError(errno.ENOBUFS, "it takes no bytes: the board does not read")

    def close(self, drop: bool) -> None:
        """Leave the line without waiting for the board.

        The lock of a port is taken off by name: another descriptor of it may live a little longer.

        Args:
            drop: throw away what has not left; a connection is reset. Not after the last words: a
                board on a pseudo-terminal may not have read them yet.
        """
        with contextlib.suppress(Exception):
            if drop and self.shared:
                flush(self.fileno())
            elif drop:
                now = struct.pack("ii", 1, 0)
                self._device.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, now)
        if self.shared:
            with contextlib.suppress(Exception):
                release_descriptor(os.dup(self.fileno()))
        with contextlib.suppress(Exception):
            self._device.close()
        self._claim.close()


def is_tcp(port: str) -> bool:
    """Return whether a line is a connection and no serial port."""
    return port.startswith("tcp:")


def tcp_address(port: str) -> tuple[str, int]:
    """Return host and number of `tcp://host:port`.

    Raises:
        OSError: it is written otherwise.
    """
    with contextlib.suppress(ValueError):
        found = urlsplit(port)
        if found.hostname and found.port:
            return found.hostname, found.port
    raise OSError(errno.EINVAL, f"'{port}' is no address: write tcp://host:port")


def open_line(port: str, baud_rate: int, patience: float = 0.0) -> Line:
    """Open a line for this program alone.

    Args:
        port: path of a serial port, or `tcp://host:port`.
        baud_rate: [baud] of a serial port.
        patience: [s] to wait for another program to leave it.

    Raises:
        OSError, ValueError: it does not exist, is in use, or may not be opened.
    """
    deadline = time.monotonic() + patience
    while True:
        try:
            return Line(port, baud_rate)
        except OSError as error:
            if error.errno not in IN_USE or time.monotonic() >= deadline:
                raise
        time.sleep(0.1)


def vent_line(descriptor: int, command: bytes, duration: float) -> str:
    """Send the vent command again and again, before all that waits to be sent.

    Args:
        descriptor: of the open line; −1 if there is none.
        command: opens every chamber, complete after any half-sent bytes.
        duration: [s] for which it is repeated: bytes may be damaged.

    Returns:
        What is left to be done, or nothing if the last command has left.
    """
    if descriptor < 0:
        return f"the board cannot be reached: {ADVICE}"
    taken, end = False, time.monotonic() + duration
    try:
        flush(descriptor)
        while time.monotonic() < end:
            try:
                taken = os.write(descriptor, command) == len(command)
            except BlockingIOError:
                taken = False
                flush(descriptor)
            time.sleep(VENT_PERIOD)
        while (waiting := bytes_waiting(descriptor)) and time.monotonic() < end + CONNECT_TIME:
            time.sleep(VENT_PERIOD)
    except (OSError, termios.error) as error:
        return f"the port is gone ({error}): {ADVICE}"
    return "" if taken and not waiting else f"the board takes no bytes: {ADVICE}"


def vent_anew(port: str, command: bytes, duration: float) -> str:
    """Vent over a connection of its own, as `vent_line` does; return what is left to be done."""
    try:
        line = Line(port, alone=False)
    except OSError as error:
        return f"the board cannot be reached ({error}): {ADVICE}"
    problem = vent_line(line.fileno(), command, duration)
    line.close(drop=bool(problem))
    return problem


def release_descriptor(descriptor: int) -> None:
    """Close a descriptor of a serial port, if there is one, and take off the locks of the port."""
    if descriptor < 0:
        return
    with contextlib.suppress(OSError):
        fcntl.ioctl(descriptor, termios.TIOCNXCL)
    with contextlib.suppress(OSError):
        fcntl.flock(descriptor, fcntl.LOCK_UN)
    with contextlib.suppress(OSError):
        os.close(descriptor)


def flush(descriptor: int) -> None:
    """Throw away what is in the output queue of a terminal; a connection gives nothing back."""
    with contextlib.suppress(termios.error):
        termios.tcflush(descriptor, termios.TCOFLUSH)


def bytes_waiting(descriptor: int) -> int:
    """Return how many bytes have not left a terminal, or have not been acknowledged over TCP."""
    (waiting,) = struct.unpack("i", fcntl.ioctl(descriptor, termios.TIOCOUTQ, bytes(4)))
    return int(waiting)


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
