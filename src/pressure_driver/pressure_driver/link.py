"""The serial port and the one thread that owns it.

The thread waits for bytes from the board and for the next tick of the grid, whichever comes first.
At a tick it asks the state machine what to send and writes it; nothing else ever touches the port.
After an unplug it keeps ticking (so that the state machine stays alive), looks for the port with a
growing delay, and vents as soon as it is back.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import serial
from serial.tools import list_ports

from pressure_driver.grid import NANOSECONDS, TickGrid
from pressure_driver.realtime import prefer_thread

FIRST_RETRY = 0.1
"""[s] after a lost port until it is looked for again."""
LAST_RETRY = 2.0
"""[s] between looks after a long absence."""
STABLE_NAMES = Path("/dev/serial/by-id")
"""Where the system keeps names of ports that survive re-plugging."""
VENT_REPEATS = 3
"""How often the vent command is sent at the end: there may be no checksum, and no second chance."""


class PortError(RuntimeError):
    """The serial port cannot be used; the message names it, the cause and the remedy."""


class LinkClient(Protocol):
    """What the port's thread calls. All of it runs in that thread."""

    def opening(self) -> bytes:
        """Return what to send first after the port has opened."""

    def tick(self, instant: int) -> bytes:
        """Return what to send for the tick at this wall time [ns]."""

    def sent(self, instant: int) -> None:
        """The bytes of the tick have been handed to the operating system."""

    def received(self, data: bytes) -> None:
        """Bytes have come from the board."""

    def lost(self, reason: str) -> None:
        """The port is gone."""

    def farewell(self) -> bytes:
        """Return the vent command, for the end and for urgent requests."""


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


def _explain(port: str, error: Exception) -> str:
    """Return a sentence with the cause and the remedy of a port that does not open."""
    number = getattr(error, "errno", None)
    ports = ", ".join(available_ports()) or "none"
    if not Path(port).exists() or number == errno.ENOENT:
        return (
            f"no serial device {port}; ports that exist: {ports}. Plug the board in, or set the "
            "parameter 'port'"
        )
    if number in (errno.EAGAIN, errno.EBUSY, errno.EWOULDBLOCK) or "lock" in str(error).lower():
        return (
            f"serial port {port} is in use by another program; find it with 'fuser -v {port}', "
            f"close it, or set the parameter 'port' (ports that exist: {ports})"
        )
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
        raise PortError(_explain(port, error)) from error
    with contextlib.suppress(OSError):
        fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
    return device


class SerialLink:
    """Owns the port: ticks, writes, reads, reconnects and says goodbye.

    Args:
        port: device or by-id name.
        baud_rate: of the protocol.
        grid: of the ticks.
        client: is asked what to send and told what came.
        real_time_priority: SCHED_FIFO priority for the thread, 0 for none; refused quietly where
            the user has no right to it (see `real_time`).
        log: takes a sentence for the log.
    """

    def __init__(
        self,
        port: str,
        baud_rate: int,
        grid: TickGrid,
        client: LinkClient,
        real_time_priority: int = 0,
        log: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.port = stable_name(port)
        self.baud_rate = baud_rate
        self.grid = grid
        self.bytes_sent = 0
        self.bytes_received = 0
        self.reconnects = 0
        self.connected = False
        self.real_time = False
        """Whether the thread runs with real-time priority."""
        self.error: Exception | None = None
        """What ended the thread, if it did not end by `close`."""
        self.lateness: deque[float] = deque(maxlen=1200)
        """[s] from the instant of each of the last ticks to the thread's waking for it."""
        self.hand_over: deque[float] = deque(maxlen=1200)
        """[s] from the instant of each of the last ticks to the end of the write to the port."""
        self._client = client
        self._priority = real_time_priority
        self._log = log
        self._device: serial.Serial | None = None
        self._bytes_waiting: select.epoll | None = None
        self._unsent = b""
        self._retry_delay = FIRST_RETRY
        self._retry_at = 0.0
        self._stop = False
        self._urgent = False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_write, False)
        self._thread = threading.Thread(target=self._run, name="serial link", daemon=True)

    def start(self) -> None:
        """Open the port and start the thread.

        Raises:
            PortError: the port cannot be opened.
        """
        self._device = open_port(self.port, self.baud_rate)
        self._thread.start()

    def urge(self) -> None:
        """Have the vent command sent now, without waiting for the tick. From any thread."""
        self._urgent = True
        self._wake()

    def close(self, timeout: float = 2.0) -> bool:
        """Vent the board, close the port and end the thread.

        Returns:
            Whether the thread has ended in time.
        """
        self._stop = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def _wake(self) -> None:
        with contextlib.suppress(OSError):
            os.write(self._wake_write, b"\0")

    # ---------------------------------------------------------------------- in the thread

    def _run(self) -> None:
        try:
            self.real_time = prefer_thread(self._priority)
            self._opened()
            while not self._stop:
                self._turn()
        except Exception as error:
            self.error = error
        finally:
            self._say_goodbye()

    def _turn(self) -> None:
        """Wait for bytes or the tick, and serve what came."""
        if self._device is None and time.monotonic() >= self._retry_at:
            self._reopen()
        delay = max(self.grid.delay(time.time_ns()), 0.0)
        watched = [self._wake_read]
        if self._bytes_waiting is not None:
            watched.append(self._bytes_waiting.fileno())
        readable, _, _ = select.select(watched, [], [], delay)
        wall = time.time_ns()
        instant = self.grid.take(wall, time.monotonic_ns())
        if instant is not None:
            self._write(self._client.tick(instant))
            self.lateness.append((wall - instant) / NANOSECONDS)
            self.hand_over.append((time.time_ns() - instant) / NANOSECONDS)
            self._client.sent(instant)
        if self._wake_read in readable:
            os.read(self._wake_read, 64)
            if self._urgent:
                self._urgent = False
                self._write(self._client.farewell())
        if self._bytes_waiting is not None and self._bytes_waiting.fileno() in readable:
            self._read()

    def _read(self) -> None:
        """Take the bytes that are there; none means that the device has gone."""
        assert self._device is not None
        assert self._bytes_waiting is not None
        self._bytes_waiting.poll(0)
        try:
            data = self._device.read(max(self._device.in_waiting, 1))
        except (serial.SerialException, OSError) as error:
            self._lose(f"reading from {self.port} failed: {error}")
            return
        self.bytes_received += len(data)
        self._client.received(data)

    def _write(self, data: bytes) -> None:
        """Hand bytes to the operating system without ever waiting for it.

        What it does not take is sent before the next command; if that is not taken either, the
        port counts as lost. (pyserial's own `write` waits for the terminal after each write.)
        """
        if self._device is None or not data:
            return
        left_over = len(self._unsent)
        pending = self._unsent + data
        try:
            count = os.write(self._device.fileno(), pending)
        except BlockingIOError:
            count = 0
        except (serial.SerialException, OSError) as error:
            self._lose(f"writing to {self.port} failed: {error}")
            return
        self.bytes_sent += count
        self._unsent = pending[count:]
        if count < left_over:
            self._lose(f"{self.port} takes no bytes")

    def _opened(self) -> None:
        assert self._device is not None
        # Edge-triggered: to ask a terminal that has no bytes (as `select` on it does) makes the
        # kernel finish pending deliveries first, which on busy cores takes milliseconds.
        self._bytes_waiting = select.epoll()
        self._bytes_waiting.register(self._device.fileno(), select.EPOLLIN | select.EPOLLET)
        self.connected = True
        self._retry_delay = FIRST_RETRY
        self._write(self._client.opening())

    def _lose(self, reason: str) -> None:
        """Close what is left of the port and arrange for the next attempt."""
        if self._bytes_waiting is not None:
            self._bytes_waiting.close()
            self._bytes_waiting = None
        if self._device is not None:
            with contextlib.suppress(Exception):
                self._device.close()
        self._device = None
        self._unsent = b""
        self.connected = False
        self._retry_at = time.monotonic() + self._retry_delay
        self._log(reason)
        self._client.lost(f"serial link lost: {reason}")

    def _reopen(self) -> None:
        try:
            self._device = open_port(self.port, self.baud_rate)
        except PortError:
            self._retry_delay = min(self._retry_delay * 1.6, LAST_RETRY)
            self._retry_at = time.monotonic() + self._retry_delay
            return
        self.reconnects += 1
        self._log(f"{self.port} is back")
        self._opened()

    def _say_goodbye(self) -> None:
        """Send the vent command, wait until it is on the wire, and close."""
        device = self._device
        if device is None:
            return
        with contextlib.suppress(Exception):
            farewell = self._unsent + self._client.farewell() * VENT_REPEATS
            device.write(farewell)
            self.bytes_sent += len(farewell)
            deadline = time.monotonic() + 0.5
            while device.out_waiting and time.monotonic() < deadline:
                time.sleep(0.002)
            # The last bytes may still be in the port's hardware buffer.
            time.sleep(64 * 10 / self.baud_rate)
        with contextlib.suppress(Exception):
            fcntl.ioctl(device.fileno(), termios.TIOCNXCL)
        with contextlib.suppress(Exception):
            device.close()
        if self._bytes_waiting is not None:
            self._bytes_waiting.close()
        self._device = self._bytes_waiting = None
        self.connected = False
