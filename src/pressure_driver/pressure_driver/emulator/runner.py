"""Runs an emulated board in real time, on a pseudo-terminal that behaves as a USB serial port.

The port has a stable name and a baud rate, and can be unplugged.
"""

from __future__ import annotations

import contextlib
import fcntl
import math
import os
import pty
import select
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pressure_driver.emulator.board import EmulatedBoard, Faults, ReceivedCommand
from pressure_driver.lines import BoardSocket, is_tcp, prefer_thread
from pressure_driver.schedule import NANOSECONDS

TELEMETRY_PERIOD = 50_000_000
"""[ns] 20 Hz, as boards report."""
AIR_PERIOD = 20_000_000
"""[ns] 50 Hz, at which chamber pressures are published."""
LONGEST_STEP = 0.1
"""[s] by which the board's time advances at once: when this process stands still, or the wall clock
is set, the board's watchdog does not run out meanwhile."""
BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""


class EmulatedPort:
    """The board's end of the line.

    Bytes to the host leave at the baud rate; bytes from the host reach the firmware when the last
    of them would have come over a real line.

    Args:
        link: path of the symbolic link that a driver opens.
        baud_rate: [baud] of both directions; 0 for a line without delay.

    Raises:
        FileExistsError: another emulator serves ``link``, or something that is not a symbolic link
            stands there.
    """

    def __init__(self, link: str, baud_rate: int) -> None:
        self.link = Path(link)
        self._byte_time = round(BITS_PER_BYTE * 1e9 / baud_rate) if baud_rate else 0
        self._master: int | None = None
        self._outgoing = bytearray()
        self._sent_until = 0
        self._incoming: deque[tuple[int, int, bytes]] = deque()
        self._line_free = 0
        self.host_present = False
        self._claim()
        self.plug()

    def _claim(self) -> None:
        """Keep other emulators from this link; the kernel lets go of it with the process."""
        self._claim_path = self.link.with_name(f"{self.link.name}.lock")
        self._claim_file = os.open(self._claim_path, os.O_CREAT | os.O_RDWR, 0o644)
        try:
            fcntl.flock(self._claim_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(self._claim_file)
            raise FileExistsError(
                f"another emulator serves {self.link}: stop it, or set the parameter 'port_link'"
            ) from None

    def plug(self) -> None:
        """Appear, under the stable name."""
        if self._master is not None:
            return
        if self.link.exists() and not self.link.is_symlink():
            raise FileExistsError(
                f"{self.link} is in the way: remove it, or set the parameter 'port_link'"
            )
        master, slave = pty.openpty()
        tty.setraw(slave)
        device = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(master, False)
        temporary = self.link.with_name(f"{self.link.name}.{os.getpid()}")
        temporary.symlink_to(device)
        temporary.replace(self.link)
        self._master = master

    def unplug(self) -> None:
        """Disappear, in the middle of whatever was being said."""
        if self._master is None:
            return
        with contextlib.suppress(OSError):
            self.link.unlink()
        os.close(self._master)
        self._master = None
        self.host_present = False
        self._outgoing.clear()
        self._incoming.clear()

    def watched(self) -> list[int]:
        """Return the descriptors to wait for; empty while no host has the port open."""
        return [] if self._master is None or not self.host_present else [self._master]

    def read(self, now: int) -> bool:
        """Take what the host has sent, as of now [ns]; return whether it just opened the port."""
        if self._master is None:
            return False
        was_present = self.host_present
        try:
            data = os.read(self._master, 4096)
            self.host_present = True
        except BlockingIOError:
            self.host_present = True
            return not was_present
        except OSError:  # nobody has the other end open
            self.host_present = False
            self._outgoing.clear()
            return False
        first = max(now, self._line_free)
        self._line_free = first + len(data) * self._byte_time
        self._incoming.append((self._line_free, first, data))
        return not was_present

    def arrived(self, now: int) -> list[tuple[int, bytes]]:
        """Return (arrival of the first byte [ns], bytes) of what the firmware can read now."""
        ready = []
        while self._incoming and self._incoming[0][0] <= now:
            _, first, data = self._incoming.popleft()
            ready.append((first, data))
        return ready

    def send(self, data: bytes) -> None:
        """Queue bytes for the host; they are dropped while nobody listens."""
        if self.host_present:
            self._outgoing += data

    def pump(self, now: int) -> None:
        """Write as many queued bytes as the line has had time for."""
        if not self._outgoing or self._master is None:
            self._sent_until = now
            return
        count = len(self._outgoing)
        if self._byte_time:
            count = min(count, (now - self._sent_until) // self._byte_time)
        if count <= 0:
            return
        try:
            written = os.write(self._master, bytes(self._outgoing[:count]))
        except BlockingIOError:
            self._outgoing.clear()  # the host does not read: a real line loses bytes, too
            return
        except OSError:
            self.host_present = False
            self._outgoing.clear()
            return
        del self._outgoing[:written]
        self._sent_until = max(self._sent_until + written * self._byte_time, now - 10**8)

    def next_event(self, now: int) -> int:
        """Return the time [ns] until the line needs service, if no byte comes first."""
        waits = [20_000_000]
        if self._incoming:
            waits.append(self._incoming[0][0] - now)
        if self._outgoing:
            waits.append(2_000_000)
        return max(0, min(waits))

    def close(self) -> None:
        """Remove the port for good."""
        self.unplug()
        with contextlib.suppress(OSError):
            self._claim_path.unlink()
            os.close(self._claim_file)


def emulated_line(link: str, baud_rate: int) -> EmulatedPort | BoardSocket:
    """Return the board's end of `tcp://host:port`, or of a serial port with a symbolic link."""
    return BoardSocket(link) if is_tcp(link) else EmulatedPort(link, baud_rate)


class BoardRunner:
    """Keeps the firmware, the air and the line going.

    Args:
        board: firmware and air.
        port: the line.
        on_air: takes the wall time [ns] and the true chamber pressures (2M,) [Pa], at 50 Hz.
        on_command: takes each command that the board has received.
        real_time_priority: SCHED_FIFO priority, 0 for none.
        reset_on_open: a host that opens the port restarts the board, as on boards whose reset is
            wired to DTR.
    """

    def __init__(
        self,
        board: EmulatedBoard,
        port: EmulatedPort | BoardSocket,
        on_air: Callable[[int, NDArray[np.float64]], None] = lambda *_: None,
        on_command: Callable[[ReceivedCommand], None] = lambda *_: None,
        real_time_priority: int = 0,
        reset_on_open: bool = True,
    ) -> None:
        self.board = board
        self.port = port
        self.error = ""
        """Why the board has ended, if it has."""
        self._on_air = on_air
        self._on_command = on_command
        self._priority = real_time_priority
        self._reset_on_open = reset_on_open
        self._requests: deque[Faults] = deque()
        self._delayed: deque[tuple[int, bytes]] = deque()
        self._replug_at = math.inf
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="board", daemon=True)

    def start(self) -> None:
        """Power up."""
        self._thread.start()

    def close(self) -> None:
        """Power down and remove the port."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self.port.close()

    def set_faults(self, faults: Faults) -> None:
        """Have these faults from the next moment on, and no others. From any thread."""
        self._requests.append(faults)

    def _run(self) -> None:
        prefer_thread(self._priority)
        try:
            self._loop()
        except Exception as error:
            self.error = f"the emulated board ended: {type(error).__name__}: {error}"

    def _loop(self) -> None:
        now = time.time_ns()
        next_telemetry, next_air, air_time = now, now, now
        while not self._stop.is_set():
            now = time.time_ns()
            due = min(next_telemetry, next_air) - now
            wait = max(0, min(due, self.port.next_event(now))) / NANOSECONDS
            select.select(self.port.watched(), [], [], wait)
            now = time.time_ns()
            self._serve_line(now)
            while self._requests:
                self._apply(self._requests.popleft(), now)
            if now >= self._replug_at:
                self.port.plug()
            if now >= next_air or now >= next_telemetry:
                elapsed = (now - air_time) / NANOSECONDS
                pressure = self.board.step(min(max(elapsed, 0.0), LONGEST_STEP))
                air_time = now
                if now >= next_air:
                    self._on_air(now, pressure)
                    next_air = _following(next_air, now, AIR_PERIOD)
            if now >= next_telemetry:
                delay = round(self.board.faults.delay * NANOSECONDS)
                self._delayed.append((now + delay, self.board.telemetry()))
                next_telemetry = _following(next_telemetry, now, TELEMETRY_PERIOD)
            while self._delayed and self._delayed[0][0] <= now:
                self.port.send(self._delayed.popleft()[1])

    def _serve_line(self, now: int) -> None:
        if self.port.read(now) and self._reset_on_open:
            self.port.send(self.board.boot())
        for stamp, data in self.port.arrived(now):
            commands, answer = self.board.receive(data, stamp)
            if answer:
                self.port.send(answer)
            for command in commands:
                self._on_command(command)
        self.port.pump(now)

    def _apply(self, faults: Faults, now: int) -> None:
        self.board.set_faults(faults)
        if faults.reset is not None:
            self.board.restart(faults.reset)
        if faults.unplug is None:
            self.port.plug()
        else:
            self.port.unplug()
            self._replug_at = now + faults.unplug * NANOSECONDS


def _following(due: int, now: int, period: int) -> int:
    """Return the next multiple after a due one, skipping what has been missed."""
    return due + max(1, (now - due) // period + 1) * period
