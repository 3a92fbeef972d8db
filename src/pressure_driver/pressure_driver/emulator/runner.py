"""Runs an emulated board in real time."""

from __future__ import annotations

import math
import select
import threading
import time
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pressure_driver.emulator.board import EmulatedBoard, Faults
from pressure_driver.emulator.line import BoardLine
from pressure_driver.lines import prefer_thread
from pressure_driver.schedule import NANOSECONDS

TELEMETRY_PERIOD = 50_000_000
"""[ns] 20 Hz, as boards report."""
AIR_PERIOD = 20_000_000
"""[ns] 50 Hz, at which chamber pressures are published."""
LONGEST_LOOK = 20_000_000
"""[ns] between two looks for a host that opens the line."""
LONGEST_STEP = 0.1
"""[s] by which the board's time advances at once: when this process stands still, or the wall clock
is set, the board's watchdog does not run out meanwhile."""


class BoardRunner:
    """Keeps the firmware, the air and the line going.

    Args:
        board: firmware and air.
        port: the line.
        on_air: takes the wall time [ns] and the true chamber pressures (2M,) [Pa], at 50 Hz.
        on_command: takes the wall time [ns] at which a command has come, and its pressures (2M,)
            [Pa], absolute.
        real_time_priority: SCHED_FIFO priority, 0 for none.
    """

    def __init__(
        self,
        board: EmulatedBoard,
        port: BoardLine,
        on_air: Callable[[int, NDArray[np.float64]], None] = lambda *_: None,
        on_command: Callable[[int, tuple[float, ...]], None] = lambda *_: None,
        real_time_priority: int = 0,
    ) -> None:
        self.board = board
        self.port = port
        self.error = ""
        """Why the board has ended, if it has."""
        self._on_air = on_air
        self._on_command = on_command
        self._priority = real_time_priority
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
            due = min(next_telemetry, next_air, now + LONGEST_LOOK) - now
            select.select(self.port.watched(), [], [], max(due, 0) / NANOSECONDS)
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
                    next_air = now + AIR_PERIOD - (now - next_air) % AIR_PERIOD
            if now >= next_telemetry:
                delay = round(self.board.faults.delay * NANOSECONDS)
                self._delayed.append((now + delay, self.board.telemetry()))
                next_telemetry = now + TELEMETRY_PERIOD - (now - next_telemetry) % TELEMETRY_PERIOD
            while self._delayed and self._delayed[0][0] <= now:
                self.port.send(self._delayed.popleft()[1])

    def _serve_line(self, now: int) -> None:
        was_present, data = self.port.host_present, self.port.read()
        if self.port.boots_when_opened and self.port.host_present and not was_present:
            self.port.send(self.board.boot())
        if data:
            commands, answer = self.board.receive(data)
            self.port.send(answer)
            for pressure in commands:
                self._on_command(now, pressure)

    def _apply(self, faults: Faults, now: int) -> None:
        self.board.set_faults(faults)
        if faults.reset is not None:
            self.board.restart(faults.reset)
        if faults.unplug is None:
            self.port.plug()
        else:
            self.port.unplug()
            self._replug_at = now + faults.unplug * NANOSECONDS
