"""Serial ports of this machine: which there are, by which name to keep one, how to open it."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import struct
import termios
import time
from pathlib import Path

import serial
from serial.tools import list_ports

STABLE_NAMES = Path("/dev/serial/by-id")
"""Where the system keeps names of ports that survive re-plugging."""
RELEASE_TIME = 4.0
"""[s] in which a process that vents after the end of its driver has let go of the port."""
VENT_TIME = 1.0
"""[s] for which one process of the driver vents in the place of the other."""
VENT_PERIOD = 0.05
"""[s] between two of its vent commands."""
ADVICE = "close the air supply"


class PortError(RuntimeError):
    """The serial port cannot be used; the message names it, the cause and the remedy."""

    in_use = False
    """Whether another program has it."""


def available_ports() -> list[str]:
    """Return the serial ports of this machine, by their stable names where there are any."""
    by_id = sorted(map(str, STABLE_NAMES.iterdir())) if STABLE_NAMES.is_dir() else []
    known = {os.path.realpath(path) for path in by_id}
    others = [port.device for port in list_ports.comports() if port.device not in known]
    emulated = sorted(str(path) for path in Path("/tmp").glob("der_limb_board_*"))
    return by_id + sorted(others) + emulated


def stable_name(port: str) -> str:
    """Return the by-id name of a port, which survives re-plugging, or the name itself."""
    if STABLE_NAMES.is_dir():
        for path in sorted(STABLE_NAMES.iterdir()):
            if os.path.realpath(path) == os.path.realpath(port):
                return str(path)
    return port


def _is_locked(error: Exception) -> bool:
    number = getattr(error, "errno", None)
    return number in (errno.EAGAIN, errno.EBUSY) or "lock" in str(error).lower()


def _explain(port: str, error: Exception) -> str:
    """Return a sentence with the cause and the remedy of a port that does not open."""
    number = getattr(error, "errno", None)
    ports = ", ".join(available_ports()) or "none"
    if not Path(port).exists() or number == errno.ENOENT:
        return (
            f"no serial device {port}; ports that exist: {ports}. Plug the board in, or set the "
            "parameter 'port'"
        )
    if _is_locked(error):
        return (
            f"serial port {port} is in use by another program; find it with 'fuser -v {port}', "
            f"close it, or set the parameter 'port' (ports that exist: {ports})"
        )
    if number in (errno.EISDIR, errno.ENOTTY, errno.EINVAL) or "ioctl" in str(error):
        return f"{port} is no serial port; ports that exist: {ports}: set the parameter 'port'"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission to open {port}: sudo usermod -a -G dialout $USER, then log in again"
    return f"cannot open serial port {port}: {error}; ports that exist: {ports}"


def open_port(port: str, baud_rate: int) -> serial.Serial:
    """Open a serial port for this program alone.

    Raises:
        PortError: it does not exist, is in use, or may not be opened.
    """
    try:
        device = serial.Serial(port, baud_rate, timeout=0, write_timeout=0.05, exclusive=True)
    except (serial.SerialException, OSError, ValueError) as error:
        problem = PortError(_explain(port, error))
        problem.in_use = Path(port).exists() and _is_locked(error)
        raise problem from error
    with contextlib.suppress(OSError):
        fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
    return device


def open_port_when_free(port: str, baud_rate: int, patience: float = RELEASE_TIME) -> serial.Serial:
    """Open a serial port, waiting up to ``patience`` seconds for another program to leave it.

    Raises:
        PortError: as `open_port`.
    """
    deadline = time.monotonic() + patience
    while True:
        try:
            return open_port(port, baud_rate)
        except PortError as error:
            if not error.in_use or time.monotonic() >= deadline:
                raise
        time.sleep(0.1)


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
