"""The board's end of `tcp://host:port`."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable

from pressure_driver.lines import tcp_address

LONGEST_WAIT = 20_000_000
"""[ns] between two looks for a host that wants a connection."""


class BoardSocket:
    """A board in a network: what an emulated board and `topic_board` listen with.

    Bytes cost no time. The newest connection counts: whoever makes it has to vent.

    Args:
        link: `tcp://host:port` to listen at.

    Raises:
        OSError: the address is not this computer's, or another program listens there.
    """

    def __init__(self, link: str) -> None:
        self.link = link
        self._server: socket.socket | None = None
        self._host: socket.socket | None = None
        self._incoming: list[tuple[int, bytes]] = []
        self._outgoing = bytearray()
        self.plug()

    @property
    def host_present(self) -> bool:
        """Whether a host has a connection."""
        return self._host is not None

    def plug(self) -> None:
        """Listen."""
        if self._server is None:
            self._server = socket.create_server(tcp_address(self.link))
            self._server.setblocking(False)

    def unplug(self) -> None:
        """Reset the connection and listen no more."""
        for each in (self._server, self._host):
            if each is not None:
                each.close()
        self._server = self._host = None
        self._incoming.clear()
        self._outgoing.clear()

    def watched(self) -> list[int]:
        """Return the descriptors to wait for."""
        return [each.fileno() for each in (self._server, self._host) if each is not None]

    def read(self, now: int, clock: Callable[[], int] | None = None) -> bool:  # noqa: ARG002
        """Take what the host has sent, as of now [ns]; nobody restarts a board in a network."""
        with contextlib.suppress(BlockingIOError):
            while self._server is not None:
                host, _ = self._server.accept()
                self._hear(now)
                if self._host is not None:
                    self._host.close()
                self._host = host
                host.setblocking(False)
                host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._hear(now)
        return False

    def _hear(self, now: int) -> None:
        """Take what the host has sent, or see that it has gone."""
        if self._host is None:
            return
        data = b""
        with contextlib.suppress(BlockingIOError):
            with contextlib.suppress(ConnectionError):
                data = self._host.recv(1 << 16)
            if data:
                self._incoming.append((now, data))
            else:
                self._host.close()
                self._host = None

    def arrived(self, now: int) -> list[tuple[int, bytes]]:  # noqa: ARG002 - bytes cost no time
        """Return (arrival [ns], bytes) of what the firmware can read now."""
        ready, self._incoming = self._incoming, []
        return ready

    def send(self, data: bytes) -> None:
        """Queue bytes for the host; they are dropped while nobody listens."""
        if self._host is not None:
            self._outgoing += data

    def pump(self, now: int) -> None:  # noqa: ARG002 - bytes cost no time
        """Write what is queued; a host that does not read loses it."""
        if self._host is not None:
            with contextlib.suppress(OSError):
                self._host.send(self._outgoing)
        self._outgoing.clear()

    def next_event(self, now: int) -> int:  # noqa: ARG002
        """Return the time [ns] until the line needs service, if no byte comes first."""
        return 0 if self._incoming else LONGEST_WAIT

    def close(self) -> None:
        """Leave the network for good."""
        self.unplug()
