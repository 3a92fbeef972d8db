"""The board's end of `tcp://host:port`: it listens to several hosts at once, as terminals do."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from collections.abc import Callable

from pressure_driver.lines import tcp_address

LONGEST_WAIT = 20_000_000
"""[ns] between two looks for hosts that want a connection."""


class BoardSocket:
    """A board in a network: what an emulated board and `topic_board` listen with.

    Bytes cost no time. What a host asks is answered to the host that has spoken last.

    Args:
        link: `tcp://host:port` to listen at.

    Raises:
        OSError: the address is not this computer's, or another program listens there.
    """

    def __init__(self, link: str) -> None:
        self.link = link
        self._server: socket.socket | None = None
        self._hosts: list[socket.socket] = []
        self._incoming: deque[tuple[int, bytes]] = deque()
        self._outgoing = bytearray()
        self.plug()

    @property
    def host_present(self) -> bool:
        """Whether a host has a connection."""
        return bool(self._hosts)

    def plug(self) -> None:
        """Listen."""
        if self._server is None:
            self._server = socket.create_server(tcp_address(self.link))
            self._server.setblocking(False)

    def unplug(self) -> None:
        """Reset every connection and listen no more."""
        if self._server is None:
            return
        for each in (self._server, *self._hosts):
            each.close()
        self._server = None
        self._hosts.clear()
        self._incoming.clear()
        self._outgoing.clear()

    def watched(self) -> list[int]:
        """Return the descriptors to wait for."""
        return [each.fileno() for each in (self._server, *self._hosts) if each is not None]

    def read(self, now: int, clock: Callable[[], int] | None = None) -> bool:  # noqa: ARG002
        """Take what hosts have sent, as of now [ns]; a board in a network is restarted by none."""
        if self._server is None:
            return False
        with contextlib.suppress(BlockingIOError):
            connection, _ = self._server.accept()
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._hosts.append(connection)
        for host in list(self._hosts):
            data = b""
            with contextlib.suppress(BlockingIOError):
                with contextlib.suppress(ConnectionError):
                    data = host.recv(1 << 16)
                if data:
                    self._incoming.append((now, data))
                    # The newest speaker stands last, and gets the answers.
                    self._hosts.remove(host)
                    self._hosts.append(host)
                else:
                    self._hosts.remove(host)
                    host.close()
        return False

    def arrived(self, now: int) -> list[tuple[int, bytes]]:  # noqa: ARG002 - bytes cost no time
        """Return (arrival [ns], bytes) of what the firmware can read now."""
        ready = list(self._incoming)
        self._incoming.clear()
        return ready

    def send(self, data: bytes) -> None:
        """Queue bytes for the host; they are dropped while nobody listens."""
        if self._hosts:
            self._outgoing += data

    def pump(self, now: int) -> None:  # noqa: ARG002 - bytes cost no time
        """Write what is queued; a host that does not read loses it."""
        if self._outgoing and self._hosts:
            with contextlib.suppress(OSError):
                self._hosts[-1].send(self._outgoing)
        self._outgoing.clear()

    def next_event(self, now: int) -> int:  # noqa: ARG002
        """Return the time [ns] until the line needs service, if no byte comes first."""
        return 0 if self._incoming else LONGEST_WAIT

    def close(self) -> None:
        """Leave the network for good."""
        self.unplug()
