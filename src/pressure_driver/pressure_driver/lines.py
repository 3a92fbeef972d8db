"""The two lines of the process of the port: the serial one to the board, the socket to the node."""

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

import serial

RELEASE_TIME = 4.0
"""[s] in which a process that vents after the end of its driver has let go of the port."""
VENT_TIME = 1.0
"""[s] for which one process of the driver vents in the place of the other."""
VENT_PERIOD = 0.05
"""[s] between two of its vent commands."""
ADVICE = "close the air supply"
IN_USE = (errno.EAGAIN, errno.EBUSY)
"""Error numbers of a port that another program has."""


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
