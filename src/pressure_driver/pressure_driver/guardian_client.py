"""The driver's end of the guardian: starts it, hands it the port, and shows it signs of life."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import serial

from pressure_driver import guardian

BEAT_PERIOD = 0.03
"""[s] between signs of life, at the most: several fit into `guardian.HEARTBEAT_TIMEOUT`."""
ANSWER_TIMEOUT = 2.0
"""[s] after which a guardian that does not answer counts as dead."""
FRESH_VENT = 1.0
"""[s] after which the guardian is told the vent command again, if it has changed."""
EXECUTOR_TIMEOUT = 1.0
"""[s] without a call of `GuardianClient.executor_lives`, after the first one, until signs of life
stop: a node that serves nothing any more cannot be told to vent. Longer than any pause by load."""
END_TIMEOUT = 1.0
"""[s] for the guardian to end after a goodbye."""

GUARDIAN_STARTS = 3
"""Guardians that may fail in one run of the driver before the driver gives up."""


class GuardianError(RuntimeError):
    """The guardian cannot be started, or has ended."""


class GuardianClient:
    """One guardian process at a time. All but `executor_lives` is called by the port's thread.

    Args:
        priority: real-time priority of the port's thread, 0 for none; the guardian asks for one
            more, quietly doing without where it is refused.
    """

    def __init__(self, priority: int = 0) -> None:
        self._priority = min(priority + 1, 99) if priority > 0 else 0
        self._process: subprocess.Popen[bytes] | None = None
        self._channel: socket.socket | None = None
        self._vent = b""
        self._beat_at = 0.0
        self._said_vented = True
        self._told_at = 0.0
        self._answer_at = 0.0
        self._executor_at: float | None = None

    @property
    def process_id(self) -> int | None:
        """Of the guardian; None while there is none."""
        return self._process.pid if self._process is not None else None

    def executor_lives(self) -> None:
        """Say that the node's executor serves its callbacks. From any thread."""
        self._executor_at = time.monotonic()

    def start(self, vent: bytes, port: int) -> None:
        """Start a guardian and hand it the port.

        Args:
            vent: the command that opens every chamber, complete after any half-sent bytes.
            port: descriptor of the open port.

        Raises:
            GuardianError: it cannot be started.
        """
        near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        near.setblocking(False)
        try:
            self._process = subprocess.Popen(
                [
                    *(sys.executable, "-I", "-S", str(Path(guardian.__file__))),
                    *map(str, (far.fileno(), os.getpid(), self._priority)),
                ],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=(far.fileno(),),
                start_new_session=True,
            )
        except OSError as error:
            near.close()
            raise GuardianError(f"the guardian cannot be started: {error}") from error
        finally:
            far.close()
        self._channel = near
        self._answer_at = time.monotonic()
        self.hand_over(vent, port)

    def hand_over(self, vent: bytes, port: int) -> None:
        """Tell of a port that has been opened, and of the vent command."""
        self._vent, self._told_at = vent, time.monotonic()
        with contextlib.suppress(OSError):
            assert self._channel is not None
            socket.send_fds(self._channel, [b"P" + vent], [port])

    def port_lost(self) -> None:
        """Have the guardian let go of the port."""
        self._send(b"L")

    def wants_vent(self) -> bool:
        """Tell whether it is time to say the vent command again."""
        return time.monotonic() - self._told_at >= FRESH_VENT

    def renew(self, vent: bytes) -> None:
        """Tell the vent command, which changes when the room's pressure has been measured."""
        self._told_at = time.monotonic()
        if vent != self._vent:
            self._vent = vent
            self._send(b"V" + vent)

    def beat(self, vented: bool) -> None:
        """Show a sign of life, unless the last one is young or the executor stands still.

        Args:
            vented: the last command on the wire was to vent; the guardian is more patient then.

        Raises:
            GuardianError: the guardian has ended, or does not answer.
        """
        now = time.monotonic()
        if now - self._beat_at < BEAT_PERIOD / 2.0 and vented == self._said_vented:
            return
        if self._executor_at is not None and now - self._executor_at > EXECUTOR_TIMEOUT:
            return
        self._beat_at, self._said_vented = now, vented
        if not self._send(b"z" if vented else b"."):
            raise GuardianError("the guardian has ended")
        with contextlib.suppress(BlockingIOError):
            assert self._channel is not None
            while True:
                if not self._channel.recv(64):
                    raise GuardianError("the guardian has ended")
                self._answer_at = now
        if now - self._answer_at > ANSWER_TIMEOUT:
            raise GuardianError(f"the guardian has not answered for {ANSWER_TIMEOUT:g} s")

    def _send(self, message: bytes) -> bool:
        """Return whether the guardian's end is still open; a full queue is not a closed one."""
        if self._channel is None:
            return False
        try:
            self._channel.send(message)
        except BlockingIOError:
            return True
        except OSError:
            return False
        return True

    def end(self) -> None:
        """Say goodbye and wait for the guardian's end."""
        if self._process is None or self._channel is None:
            return
        try:
            self._channel.settimeout(END_TIMEOUT)
            self._channel.send(b"G")
            self._process.wait(END_TIMEOUT)
        except (OSError, subprocess.TimeoutExpired):
            self.discard()
        self._forget()

    def discard(self) -> None:
        """End a guardian that has failed, so that it can do nothing more."""
        if self._process is not None:
            # Before the channel is closed, which it would take for the driver's end.
            self._process.kill()
            self._process.wait()
        self._forget()

    @property
    def running(self) -> bool:
        """Whether a guardian has been started and not been ended by this side."""
        return self._process is not None

    def _forget(self) -> None:
        if self._channel is not None:
            self._channel.close()
        self._process = self._channel = None


class GuardedClient(Protocol):
    """What is asked for the vent command, and told of guardians that fail."""

    def emergency(self) -> bytes:
        """Return the vent command for the guardian to keep, complete after any half-sent bytes."""

    def failed(self, reason: str) -> None:
        """Something beside the port has failed without which the limb must not be driven."""


class GuardianKeeper:
    """Has one guardian hold the port as long as it is open, if there is to be one.

    Args:
        guardian: None for boards that vent by themselves; every call then does nothing.
        client: knows the vent command.
        log: takes a sentence for the log.
    """

    def __init__(
        self, guardian: GuardianClient | None, client: GuardedClient, log: Callable[[str], None]
    ) -> None:
        self._guardian = guardian
        self._client = client
        self._log = log
        self._failures = 0

    def arm(self, device: serial.Serial | None) -> None:
        """Hand the open port to the guardian, starting one if there is none.

        Raises:
            GuardianError: it cannot be started.
        """
        if self._guardian is None or device is None:
            return
        vent, port = self._client.emergency(), device.fileno()
        if self._guardian.running:
            self._guardian.hand_over(vent, port)
        else:
            self._guardian.start(vent, port)

    def port_lost(self) -> None:
        """Have the guardian let go of the port."""
        if self._guardian is not None:
            self._guardian.port_lost()

    def show_life(self, vented: bool, device: serial.Serial | None) -> None:
        """Tell the guardian that the thread lives; replace a guardian that does not live itself.

        Args:
            vented: the last command on the wire was to vent.
            device: the port, for another guardian; None while it is lost.

        Raises:
            GuardianError: several guardians have failed, or another one cannot be started.
        """
        if self._guardian is None or not self._guardian.running:
            return
        try:
            self._guardian.beat(vented)
            if self._guardian.wants_vent():
                self._guardian.renew(self._client.emergency())
        except GuardianError as error:
            self._failures += 1
            self._client.failed(f"{error}: nothing would vent the limb if the driver died")
            self._log(f"{error}; another one is started")
            if self._failures >= GUARDIAN_STARTS:
                raise
            self._guardian.discard()
            self.arm(device)

    def calm(self) -> None:
        """Show a sign of life at the end, when a guardian that has failed is not replaced."""
        if self._guardian is not None and self._guardian.running:
            with contextlib.suppress(GuardianError):
                self._guardian.beat(vented=False)

    def end(self) -> None:
        """Say goodbye to the guardian."""
        if self._guardian is not None:
            self._guardian.end()
