"""The serial port and the one thread that owns it.

The thread waits for bytes from the board and for the next tick of the grid, whichever comes first.
At a tick it asks the state machine what to send and writes it; nothing else ever touches the port.
After an unplug it keeps ticking (so that the state machine stays alive), watches for the port's
name to come back, opens it (again and again with a growing delay if that fails), and vents at once.
Beside the ticks it shows the guardian, if there is one, that it lives.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

import serial

from pressure_driver.grid import NANOSECONDS, TickGrid
from pressure_driver.guardian_client import GuardianClient, GuardianError, GuardianKeeper
from pressure_driver.ports import (
    PortError,
    open_port,
    open_port_when_free,
    release_port,
    stable_name,
)
from pressure_driver.realtime import prefer_thread

FIRST_RETRY = 0.1
"""[s] after a lost port until it is looked for again."""
LAST_RETRY = 2.0
"""[s] between looks after a long absence."""
LONGEST_WAIT = 0.03
"""[s] after which the thread turns at the latest: to look for a lost port, to show life."""
BEFORE_TICK = 0.003
"""[s] before a tick in which no sign of life is shown: the guardian would wake beside the tick."""
UNREAD_TIME = 1.0
"""[s] that bytes may wait in the port's output queue until the board counts as not reading."""
VENT_REPEATS = 3
"""How often the vent command is sent at the end: there may be no checksum, and no second chance."""
LAST_WORDS_TIME = 0.5
"""[s] that the operating system may take to send them."""


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

    def emergency(self) -> bytes:
        """Return the vent command for the guardian to keep, complete after any half-sent bytes."""

    def failed(self, reason: str) -> None:
        """Something beside the port has failed without which the limb must not be driven."""

    @property
    def separator(self) -> bytes:
        """What ends half-sent bytes."""

    @property
    def venting(self) -> bool:
        """Whether the last tick's bytes were the vent command."""


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
        guardian: of a board without a watchdog; it is started and ended together with the port.
    """

    def __init__(
        self,
        port: str,
        baud_rate: int,
        grid: TickGrid,
        client: LinkClient,
        real_time_priority: int = 0,
        log: Callable[[str], None] = lambda _: None,
        guardian: GuardianClient | None = None,
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
        self.vented_at_end = False
        """Whether the vent commands at the end have left this computer."""
        self._client = client
        self._keeper = GuardianKeeper(guardian, client, log)
        self._priority = real_time_priority
        self._log = log
        self._device: serial.Serial | None = None
        self._bytes_waiting: select.epoll | None = None
        self._unsent = b""
        self._drained_at = 0.0
        self._was_venting = True
        self._retry_delay = FIRST_RETRY
        self._retry_at = 0.0
        self._name_exists = True
        self._stop = False
        self._urgent = False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_write, False)
        self._thread = threading.Thread(target=self._run, name="serial link", daemon=True)

    def start(self) -> None:
        """Open the port and start the thread.

        A port in use is waited for: the guardian of a killed driver vents for some seconds.

        Raises:
            PortError: the port cannot be opened.
            GuardianError: there is to be a guardian, and it cannot be started.
        """
        self._device = open_port_when_free(self.port, self.baud_rate)
        try:
            self._keeper.arm(self._device)
        except GuardianError:
            release_port(self._device)
            raise
        self._thread.start()

    def urge(self) -> None:
        """Have the vent command sent now, without waiting for the tick. From any thread."""
        self._urgent = True
        self._wake()

    def close(self, timeout: float = 4.0) -> bool:
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
        if self._device is None:
            self._look_for_port()
        delay = min(max(self.grid.delay(time.time_ns()), 0.0), LONGEST_WAIT)
        watched = [self._wake_read]
        if self._bytes_waiting is not None:
            watched.append(self._bytes_waiting.fileno())
        readable, _, _ = select.select(watched, [], [], delay)
        wall = time.time_ns()
        instant = self.grid.take(wall, time.monotonic_ns())
        if instant is not None:
            self._send_tick(instant)
            self.lateness.append((wall - instant) / NANOSECONDS)
            self.hand_over.append((time.time_ns() - instant) / NANOSECONDS)
            self._client.sent(instant)
        if self._wake_read in readable:
            os.read(self._wake_read, 64)
            if self._urgent:
                self._urgent = False
                self._drop_unsent()
                self._write(self._client.separator + self._client.farewell())
        if self._bytes_waiting is not None and self._bytes_waiting.fileno() in readable:
            self._read()
        if self.grid.delay(time.time_ns()) > BEFORE_TICK:
            self._keeper.show_life(self._was_venting, self._device)

    def _send_tick(self, instant: int) -> None:
        """Write the tick's command; the first vent command overtakes what waits to be sent."""
        data = self._client.tick(instant)
        venting = self._client.venting
        if venting and not self._was_venting:
            self._drop_unsent()
            data = self._client.separator + data
        if self._was_venting and not venting:
            self._was_venting = False
            # The guardian becomes strict before the first pressure.
            self._keeper.show_life(self._was_venting, self._device)
        self._was_venting = venting
        self._watch_queue()
        self._write(data)

    def _watch_queue(self) -> None:
        """Lose the port if what has been written stays where it is: the board does not read."""
        if self._device is None:
            return
        now = time.monotonic()
        waiting = len(self._unsent)
        with contextlib.suppress(OSError):
            waiting += self._device.out_waiting
        if not waiting:
            self._drained_at = now
        elif now - self._drained_at > UNREAD_TIME:
            self._lose(
                f"the board on {self.port} does not read: {waiting} bytes have been waiting for "
                f"{UNREAD_TIME:g} s"
            )

    def _drop_unsent(self) -> None:
        """Throw away what waits to be sent; a frame may be cut, so a separator must follow."""
        self._unsent = b""
        if self._device is not None:
            with contextlib.suppress(Exception):
                self._device.reset_output_buffer()

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
        if data:
            self._retry_delay = FIRST_RETRY
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
            self._lose(f"{self.port} takes no bytes: the board does not read")

    def _opened(self) -> None:
        assert self._device is not None
        # Edge-triggered: to ask a terminal that has no bytes (as `select` on it does) makes the
        # kernel finish pending deliveries first, which on busy cores takes milliseconds.
        self._bytes_waiting = select.epoll()
        self._bytes_waiting.register(self._device.fileno(), select.EPOLLIN | select.EPOLLET)
        self.connected = True
        self._drained_at = time.monotonic()
        self._write(self._client.opening())

    def _lose(self, reason: str) -> None:
        """Close what is left of the port and arrange for the next attempt."""
        if self._bytes_waiting is not None:
            self._bytes_waiting.close()
            self._bytes_waiting = None
        if self._device is not None:
            release_port(self._device)
        self._device = None
        self._keeper.port_lost()
        self._unsent = b""
        self.connected = False
        self._name_exists = os.path.exists(self.port)
        self._retry_at = time.monotonic() + self._retry_delay
        self._log(reason)
        self._client.lost(f"serial link lost: {reason}")

    def _look_for_port(self) -> None:
        """Open the port as soon as its name is there again; if it does not open, later again."""
        exists = os.path.exists(self.port)
        if exists and not self._name_exists:
            self._retry_at, self._retry_delay = 0.0, FIRST_RETRY
        self._name_exists = exists
        if exists and time.monotonic() >= self._retry_at:
            self._reopen()

    def _reopen(self) -> None:
        self._retry_delay = min(self._retry_delay * 1.6, LAST_RETRY)
        self._retry_at = time.monotonic() + self._retry_delay
        try:
            self._device = open_port(self.port, self.baud_rate)
        except PortError:
            return
        self._keeper.arm(self._device)
        self.reconnects += 1
        self._log(f"{self.port} is back")
        self._opened()

    # ------------------------------------------------------------------------------- the end

    def _say_goodbye(self) -> None:
        """Send the vent command, wait until it is on the wire, and close."""
        if self._device is None and self._name_exists:
            with contextlib.suppress(Exception):
                self._device = open_port(self.port, self.baud_rate)
        if self._device is not None:
            with contextlib.suppress(Exception):
                self.vented_at_end = self._send_last_words(self._device)
            release_port(self._device, drop=not self.vented_at_end)
        if self._bytes_waiting is not None:
            self._bytes_waiting.close()
        self._device = self._bytes_waiting = None
        self.connected = False
        self._keeper.end()

    def _send_last_words(self, device: serial.Serial) -> bool:
        """Return whether the vent commands have left the operating system in time."""
        self._drop_unsent()
        farewell = self._client.separator + self._client.farewell() * VENT_REPEATS
        deadline = time.monotonic() + LAST_WORDS_TIME
        while farewell or device.out_waiting:
            if time.monotonic() > deadline:
                return False
            self._keeper.calm()
            with contextlib.suppress(BlockingIOError):
                count = os.write(device.fileno(), farewell)
                self.bytes_sent += count
                farewell = farewell[count:]
            time.sleep(0.002)
        # The last bytes may still be in the port's hardware buffer.
        deadline = time.monotonic() + 64 * 10 / self.baud_rate
        while time.monotonic() < deadline:
            self._keeper.calm()
            time.sleep(0.002)
        return True
