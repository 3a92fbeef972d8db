"""The guardian: a process of its own that vents a board when its driver stops giving signs of life.

It is started by `pressure_driver.guardian_client` beside the driver of a board without a watchdog,
by its path and with nothing but the standard library, so that it runs within some hundredths of a
second and hardly anything in it can fail. The driver goes on writing to the port itself; the
guardian holds a second descriptor of the open port, which it does not use while the driver lives.

Messages come over a socket that keeps their bounds (one letter, then contents):

===== =========================================================================================
``P`` the vent command; with it comes the descriptor of the port that has been opened
``V`` a newer vent command
``L`` the port is lost: close the descriptor, so that the device can come back under its name
``.`` a sign of life of a driver that commands pressures; it is answered with this letter
``z`` a sign of life of a driver that has told the board to vent; it is answered with ``.``
``G`` the driver has vented the board and ends: close everything and end with exit code 0
===== =========================================================================================

If no sign of life comes for `HEARTBEAT_TIMEOUT` (`VENTED_TIMEOUT` after a ``z``: the board holds no
pressure then, and a driver that starts may well be slow), or the socket closes without a ``G``, the
guardian kills the driver (one that hangs must not wake up later and write old pressures), throws
away what waits in the port's output queue, sends the vent command for `VENT_TIME`, and ends with
exit code 1. It has a session of its own and ignores the signals by which people and terminals end
programs.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import socket
import sys
import termios
import threading
import time

HEARTBEAT_TIMEOUT = 0.22
"""[s] without a sign of life. The rest of the promised 0.3 s is for the kill and the first vent."""
VENTED_TIMEOUT = 3.0
"""[s] the same while the last command on the wire was to vent: nothing presses then."""
LATE_WAKE = 0.05
"""[s] The guardian woke up this much too late: the whole machine stood still, the driver too."""
END_TIMEOUT = 0.04
"""[s] to wait until a killed driver has let go of its descriptors."""
VENT_TIME = 2.0
"""[s] for which the vent command is repeated: there may be no checksum, and damaged bytes."""
VENT_PERIOD = 0.05
"""[s] between two vent commands."""
SAYING_TIME = 0.02
"""[s] to wait until a message is written while the board is vented; then it is left to itself."""
LAST_WORDS_TIME = 0.5
"""[s] the same at the end."""
ADVICE = "close the air supply"
_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP)


def _say(text: str, patience: float = LAST_WORDS_TIME) -> None:
    """Write to standard error without ever waiting for it.

    It may have gone together with its terminal, or be one that nobody reads: a terminal after
    Ctrl-S, a full pipe. A vent must not wait for either.
    """

    def write() -> None:
        with contextlib.suppress(OSError):
            os.write(2, f"guardian: {text}\n".encode())

    writer = threading.Thread(target=write, daemon=True)
    writer.start()
    writer.join(patience)


class Guardian:
    """Waits for signs of life and vents when they stop.

    Args:
        channel: socket to the driver, of a kind that keeps the bounds of messages.
        driver: process id of the driver, which is this process's parent.
    """

    def __init__(self, channel: socket.socket, driver: int) -> None:
        self._channel = channel
        self._driver = driver
        self._port = -1
        self._vent = b""
        self._timeout = VENTED_TIMEOUT

    def run(self) -> int:
        """Return the exit code: 0 after a goodbye, 1 after a driver that had to be replaced."""
        reason = self._listen()
        if not reason:
            self._close_port()
            return 0
        self._end_driver()
        self._flush_and_vent()
        _say(f"{reason}: the driver was ended", SAYING_TIME)
        self._vent_board()
        return 1

    def _listen(self) -> str:
        """Serve messages; return why the driver counts as failed, or nothing after a goodbye."""
        deadline = time.monotonic() + self._timeout
        while True:
            planned = max(deadline - time.monotonic(), 0.0)
            begin = time.monotonic()
            if not select.select([self._channel], [], [], planned)[0]:
                now = time.monotonic()
                if now - begin > planned + LATE_WAKE:
                    deadline = now + LATE_WAKE
                    continue
                return f"no sign of life from the driver for {self._timeout:g} s"
            message, descriptors = self._receive()
            if not message:
                return "the driver has ended without a goodbye"
            if message == b"G":
                return ""
            self._take(message, descriptors)
            # Whatever comes is a sign of life; one that has waited here counts from now on.
            deadline = time.monotonic() + self._timeout

    def _receive(self) -> tuple[bytes, list[int]]:
        try:
            message, descriptors, _, _ = socket.recv_fds(self._channel, 4096, 4)
        except OSError:
            return b"", []
        return message, list(descriptors)

    def _take(self, message: bytes, descriptors: list[int]) -> None:
        kind, contents = message[:1], message[1:]
        if kind in b".z":
            self._timeout = VENTED_TIMEOUT if kind == b"z" else HEARTBEAT_TIMEOUT
            with contextlib.suppress(OSError):
                self._channel.send(b".", socket.MSG_DONTWAIT)
        if kind in b"PV":
            self._vent = contents
        if kind in b"PL":
            self._close_port()
        for descriptor in descriptors:
            self._port = descriptor

    def _end_driver(self) -> None:
        """Kill the driver and wait until it cannot write any more."""
        # Only while it is still the parent: its number may belong to another process by now.
        if os.getppid() == self._driver:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._driver, signal.SIGKILL)
        deadline = time.monotonic() + END_TIMEOUT
        while (rest := deadline - time.monotonic()) > 0.0:
            if not select.select([self._channel], [], [], rest)[0]:
                return
            message, descriptors = self._receive()
            if not message:
                return
            if message != b"G":
                self._take(message, descriptors)

    def _flush_and_vent(self) -> None:
        """Send the vent command once, before everything that waits to be sent."""
        if self._port < 0:
            return
        with contextlib.suppress(termios.error):
            termios.tcflush(self._port, termios.TCOFLUSH)
        with contextlib.suppress(OSError):
            os.write(self._port, self._vent)

    def _vent_board(self) -> None:
        """Send the vent command for `VENT_TIME`."""
        if self._port < 0:
            _say(f"the board cannot be reached: {ADVICE}")
            return
        count, end = 0, time.monotonic() + VENT_TIME
        while time.monotonic() < end:
            try:
                count += os.write(self._port, self._vent) == len(self._vent)
            except BlockingIOError:
                with contextlib.suppress(termios.error):
                    termios.tcflush(self._port, termios.TCOFLUSH)
            except OSError as error:
                _say(f"the port is gone ({error}) after {count} vent commands: {ADVICE}")
                return
            time.sleep(VENT_PERIOD)
        if count:
            _say(f"the vent command was sent {count} times; check that the chambers are down")
        else:
            _say(f"the board takes no bytes: {ADVICE}")
        self._close_port()

    def _close_port(self) -> None:
        """Let go of the port, and of the lock that other programs respect."""
        if self._port < 0:
            return
        with contextlib.suppress(OSError):
            fcntl.ioctl(self._port, termios.TIOCNXCL)
        with contextlib.suppress(OSError):
            fcntl.flock(self._port, fcntl.LOCK_UN)
        with contextlib.suppress(OSError):
            os.close(self._port)
        self._port = -1


def main() -> int:
    """Guard: ``guardian.py SOCKET DRIVER PRIORITY``: descriptor, process id, real-time priority."""
    for number in _IGNORED:
        signal.signal(number, signal.SIG_IGN)
    descriptor, driver, priority = map(int, sys.argv[1:4])
    if priority > 0:
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    return Guardian(socket.socket(fileno=descriptor), driver).run()


if __name__ == "__main__":
    sys.exit(main())
