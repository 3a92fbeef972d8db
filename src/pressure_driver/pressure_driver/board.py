"""The process that owns the port of a valve board: it ticks, plays, watches and vents.

The ROS node starts it and talks with it over a socket; it has no ROS, no threads and one `select`
loop, so that nothing which holds up the node holds up the limb. `ros2 run pressure_driver board`
starts it by hand, in a terminal in the place of the node.
"""

from __future__ import annotations

import contextlib
import gc
import json
import os
import select
import signal
import socket
import sys
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

from pressure_driver import lines
from pressure_driver.core import DriverCore
from pressure_driver.following import Duration
from pressure_driver.lines import Channel, Line, open_line, vent_line
from pressure_driver.protocols import host_protocol
from pressure_driver.schedule import Origin, Setpoint, TickGrid, Verdict

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

RETRY_TIME = 0.2
"""[s] between two attempts to open a port that was lost."""
LONGEST_WAIT = 0.03
"""[s] after which the loop turns at the latest: to look for a lost port, to show life."""
UNREAD_TIME = 1.0
"""[s] that bytes may wait in the port's output queue until the board counts as not reading."""
NODE_PATIENCE = 1.0
"""[s] for which the node may say nothing."""
REFUSAL_PERIOD = 1.0
"""[s] between two lines of the log about refused setpoints."""
MOST_MESSAGES = 100
"""Messages that are served before the next look at the clock."""
LAST_WORDS_TIME = 0.2
"""[s] for which the vent command is repeated at the end: there may be no checksum."""
EMPTYING_TIME = 3.0
"""[s] in which pressures must begin to fall at the end: boards take up to 1.7 s to obey."""
EMPTYING_SHARE = 0.8
"""Of the pressure at the end, below which it counts as falling."""


class BoardProcess:
    """Plays setpoints on a board until it is told to end.

    Args:
        settings: the parameters.
        channel: to the node, or the terminal.
        patience: [s] without a message from there, after which setpoints that wait are dropped:
            nobody could stop them. The limb is then held and let down as when setpoints stop.
    """

    def __init__(self, settings: Settings, channel: Channel, patience: float) -> None:
        protocol = host_protocol(settings)
        self.core = DriverCore(protocol, settings, log=self._log)
        self.grid = TickGrid(self.core.machine.schedule.period)
        self.ending = False
        """Set to end in order."""
        self._channel = channel
        self._patience = patience
        self._port = settings.port
        self._baud_rate = settings.baud_rate or protocol.baud_rate
        self._line: Line | None = None
        self._bytes_waiting: select.epoll | None = None
        self._bytes_sent = self._bytes_read = self._bytes_received = self._reconnects = 0
        self._unread = Duration()
        self._was_venting = True
        self._retry_at = 0.0
        self._heard_at = self._said_at = self.core.clock()
        self._refused_at = 0.0
        self._node_is_silent = False
        self._real_time = lines.prefer_thread(settings.real_time_priority)

    def end(self, *_: object) -> None:
        """End in order, after the present turn of the loop: a handler of signals."""
        self.ending = True

    def run(self) -> int:
        """Serve the port until the end; return the exit code."""
        try:
            self._line = open_line(self._port, self._baud_rate, lines.RELEASE_TIME)
        except (OSError, ValueError) as error:
            self._send("failed", getattr(error, "errno", None), str(error))
            return 1
        problem, duration, node_has_ended = "", LAST_WORDS_TIME, False
        try:
            self._opened()
            gc.collect()
            gc.freeze()
            while not self.ending:
                self._turn()
            problem = self._empty()
        except EOFError:
            duration, node_has_ended = lines.VENT_TIME, True
        finally:
            unreached = self._send_last_words(duration)
        if unreached:
            alone = " (a board with a watchdog vents by itself)"
            problem = (
                f"the board on {self._port} cannot be reached and may hold its pressures"
                f"{alone if self.core.protocol.has_watchdog else ''}: {lines.ADVICE}"
            )
        self._send("ended", problem)
        if node_has_ended:
            # Whoever reads the standard error may stand still, and the limb is vented: do not wait.
            signal.alarm(1)
            told = problem or f"the vent command was sent for {duration:g} s"
            with contextlib.suppress(OSError):
                os.write(2, f"board: the driver's node has ended: {told}\n".encode())
        return 1 if problem or node_has_ended else 0

    def _send(self, *message: Any, descriptor: int | None = None) -> None:
        self._said_at = self.core.clock()
        self._channel.send(*message, descriptor=descriptor)

    def _log(self, text: str, warning: bool) -> None:
        self._send("log", text, warning)

    # ------------------------------------------------------------------------------ the loop

    def _turn(self) -> None:
        """Wait for bytes, a message or the tick, and serve what came."""
        self._look_for_port()
        delay = min(max(self.grid.delay(time.time_ns()), 0.0), LONGEST_WAIT)
        watched = [each for each in (self._channel, self._bytes_waiting) if each is not None]
        readable, _, _ = select.select(watched, [], [], delay)
        instant = self.grid.take(time.time_ns())
        if instant is not None:
            self._tick(instant)
        if self._channel in readable:
            self._serve_messages()
        if self._bytes_waiting in readable:
            self._read()
        self._show_life()

    def _tick(self, instant: int) -> None:
        """Write the tick's command; the first vent command overtakes what waits to be sent."""
        data = self.core.tick(instant)
        venting = self.core.venting
        if venting and not self._was_venting:
            self._drop_unsent()
            data = self.core.protocol.separator + data
        self._was_venting = venting
        self._watch_queue()
        self._write(data)
        written = time.time_ns()
        self.core.sent()
        state = self.core.state()
        state["bytes_sent"], state["bytes_received"] = self._bytes_sent, self._bytes_received
        state["tick_to_write"] = written - instant
        state["ticks_missed"], state["reconnects"] = self.grid.missed, self._reconnects
        state["real_time_priority"] = self._real_time
        self._send("state", state)

    # ------------------------------------------------------------------------------ the node

    def _serve_messages(self) -> None:
        with contextlib.suppress(BlockingIOError):
            for _ in range(MOST_MESSAGES):
                (word, *content), _ = self._channel.receive()
                self._heard_at = self.core.clock()
                self._serve(word, content)

    def _serve(self, word: str, content: list[Any]) -> None:
        if word == "setpoint":
            stamp, differential, plan_id, index, revision, *origin = content
            setpoint = Setpoint(stamp, tuple(differential), plan_id, index, revision)
            self._offer(setpoint, Origin(*origin))
        elif word == "arm":
            self._send("answer", *self.core.arm())
        elif word == "vent":
            self._send("answer", *self._vent_now())
        elif word == "lease":
            source, period = content
            if problem := self.core.machine.leases.renew(source, period, self.core.clock()):
                self._log(problem, True)
        elif word == "end":
            self.end()

    def _offer(self, setpoint: Setpoint, origin: Origin) -> None:
        verdict = self.core.offer(setpoint, time.time_ns(), origin)
        now = self.core.clock()
        if verdict is not Verdict.ACCEPTED and now - self._refused_at >= REFUSAL_PERIOD:
            self._refused_at = now
            self._log(f"{verdict.value}: {self.core.machine.schedule.reason}", True)

    def _vent_now(self) -> tuple[bool, str]:
        """Vent before the next tick, and before all that waits to be sent."""
        answer = self.core.vent()
        self._drop_unsent()
        self._write(self.core.protocol.emergency())
        return answer

    def _show_life(self) -> None:
        """Say something at least every `LONGEST_WAIT`, and notice a node that says nothing."""
        now = self.core.clock()
        if now - self._said_at >= LONGEST_WAIT:
            self._send("alive")
        silent = now - self._heard_at > self._patience
        if silent:
            self.core.machine.schedule.clear()
            if not self._node_is_silent:
                self._log(f"the node said nothing for {self._patience:g} s", True)
        self._node_is_silent = silent

    # ------------------------------------------------------------------------------ the port

    def _opened(self) -> None:
        assert self._line is not None
        # Edge-triggered: to ask a terminal that has no bytes (as `select` on it does) makes the
        # kernel finish pending deliveries first, which on busy cores takes milliseconds.
        self._bytes_waiting = select.epoll()
        self._bytes_waiting.register(self._line.fileno(), select.EPOLLIN | select.EPOLLET)
        self._unread = Duration()
        self._write(self.core.opening())
        if self._line is not None:
            descriptor = self._line.fileno() if self._line.shared else None
            self._send("port", descriptor=descriptor)

    def _look_for_port(self) -> None:
        """Open a port that was lost as soon as its name is there again."""
        if self._line is not None or time.monotonic() < self._retry_at:
            return
        with contextlib.suppress(OSError, ValueError):
            self._line = open_line(self._port, self._baud_rate)
            self._reconnects += 1
            self._log(f"{self._port} is back", True)
            self._opened()
        self._retry_at = time.monotonic() + RETRY_TIME

    def _watch_queue(self) -> None:
        """Lose the port if what has been written stays where it is: the board does not read."""
        if self._line is None:
            return
        now, waiting = self.core.clock(), 0
        with contextlib.suppress(OSError):
            waiting = lines.bytes_waiting(self._line.fileno())
        # What is under way to a board that is far is acknowledged later.
        read, self._bytes_read = self._bytes_read, self._bytes_sent - waiting
        self._unread.note(waiting > 0 and self._bytes_read == read, now)
        if self._unread.until(now) > UNREAD_TIME:
            self._lose(
                f"the board on {self._port} does not read: {waiting} bytes have been waiting for "
                f"{UNREAD_TIME:g} s"
            )

    def _drop_unsent(self) -> None:
        """Throw away what waits to be sent; a frame may be cut, so a separator must follow."""
        if self._line is not None:
            lines.flush(self._line.fileno())

    def _read(self) -> None:
        """Take the bytes that are there."""
        assert self._line is not None
        assert self._bytes_waiting is not None
        self._bytes_waiting.poll(0)
        try:
            data = self._line.read()
        except OSError as error:
            self._lose(f"reading from {self._port} failed: {error}")
            return
        self._bytes_received += len(data)
        self._write(self.core.received(data))

    def _write(self, data: bytes) -> None:
        """Hand bytes to the operating system without ever waiting for it.

        The port is lost if it does not take them all: there is room for many commands.
        """
        if self._line is None or not data:
            return
        try:
            self._line.write(data)
        except OSError as error:
            self._lose(f"writing to {self._port} failed: {error}")
            return
        self._bytes_sent += len(data)

    def _lose(self, reason: str) -> None:
        """Close what is left of the port and arrange for the next attempt."""
        self._release(drop=True)
        self._send("lost")
        self._retry_at = time.monotonic() + RETRY_TIME
        self._log(reason, True)
        self.core.lost(f"serial link lost: {reason}")

    def _release(self, drop: bool) -> None:
        if self._bytes_waiting is not None:
            self._bytes_waiting.close()
        if self._line is not None:
            self._line.close(drop)
        self._bytes_waiting = self._line = None

    # ------------------------------------------------------------------------------- the end

    def _empty(self) -> str:
        """Vent, and go on until the pressures fall; return what to do if they do not."""
        self._vent_now()
        before, deadline = self.core.highest_pressure(), self.core.clock() + EMPTYING_TIME
        while self.core.highest_pressure() > EMPTYING_SHARE * before:
            if self.core.clock() > deadline:
                left = self.core.highest_pressure()
                age = self.core.monitor.telemetry_age(self.core.clock())
                kept = f"keep {left:.0f} Pa"
                if age > EMPTYING_TIME / 2:
                    kept = f"held {left:.0f} Pa when last heard, {age:.1f} s ago"
                return f"the chambers on {self._port} {kept}: {lines.ADVICE}"
            self._turn()
        return ""

    def _send_last_words(self, duration: float) -> str:
        """Repeat the vent command and leave the port; return what is left to be done."""
        if self._line is None:
            with contextlib.suppress(OSError, ValueError):
                self._line = open_line(self._port, self._baud_rate)
        descriptor = -1 if self._line is None else self._line.fileno()
        problem = vent_line(descriptor, self.core.protocol.emergency(), duration)
        self._release(drop=bool(problem))
        return problem


def main() -> int:
    """Run for the node; the arguments are the descriptor of its socket and the parameters."""
    descriptor, values = sys.argv[1:]
    near = socket.socket(fileno=int(descriptor))
    near.setblocking(False)
    settings = cast("Settings", SimpleNamespace(**json.loads(values)))
    process = BoardProcess(settings, Channel(near), NODE_PATIENCE)
    # What ends the node must not end the process before it: the node says when.
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, process.end)
    return process.run()


if __name__ == "__main__":
    sys.exit(main())
