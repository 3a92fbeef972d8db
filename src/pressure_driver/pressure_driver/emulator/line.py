"""The board's end of a line: a pseudo-terminal that behaves as a USB serial port, or `tcp://`."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import socket
import tty
from abc import ABC, abstractmethod
from collections import deque
from pathlib import Path

from pressure_driver.lines import is_tcp, tcp_address

BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
LONGEST_LOOK = 20_000_000
"""[ns] between two looks for a host that opens the line."""
PACE = 2_000_000
"""[ns] between two looks while bytes leave at a baud rate."""


class BoardLine(ABC):
    """A line that can be unplugged.

    Bytes to the host leave at the baud rate; bytes from the host reach the firmware when the last
    of them would have come over a real line.

    Args:
        link: where a driver finds it.
        baud_rate: [baud] of both directions; 0 for a line without delay.
    """

    def __init__(self, link: str, baud_rate: int = 0) -> None:
        self.link = link
        self.host_present = False
        """Whether a host has the line open."""
        self._byte_time = round(BITS_PER_BYTE * 1e9 / baud_rate) if baud_rate else 0
        self._outgoing = bytearray()
        self._sent_until = 0
        self._incoming: deque[tuple[int, int, bytes]] = deque()
        self._line_free = 0

    @abstractmethod
    def plug(self) -> None:
        """Appear, if it is not there."""

    def unplug(self) -> None:
        """Disappear, in the middle of whatever was being said."""
        self.host_present = False
        self._outgoing.clear()
        self._incoming.clear()

    @abstractmethod
    def watched(self) -> list[int]:
        """Return the descriptors to wait for."""

    @abstractmethod
    def read(self, now: int) -> bool:
        """Take what the host has sent, as of now [ns]; return whether it just opened a port."""

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Hand bytes to the operating system without waiting; return how many it has taken."""

    def _take(self, data: bytes, now: int) -> None:
        first = max(now, self._line_free)
        self._line_free = first + len(data) * self._byte_time
        self._incoming.append((self._line_free, first, data))

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
        if not self._outgoing or not self.host_present:
            self._outgoing.clear()
            self._sent_until = now
            return
        count = len(self._outgoing)
        if self._byte_time:
            count = min(count, (now - self._sent_until) // self._byte_time)
        if count <= 0:
            return
        try:
            written = self._write(bytes(self._outgoing[:count]))
        except OSError:  # the host does not read, or has gone: a real line loses bytes, too
            self._outgoing.clear()
            return
        del self._outgoing[:written]
        self._sent_until = max(self._sent_until + written * self._byte_time, now - 10**8)

    def next_event(self, now: int) -> int:
        """Return the time [ns] until the line needs service, if no byte comes first."""
        waits = [PACE if self._outgoing else LONGEST_LOOK]
        if self._incoming:
            waits.append(self._incoming[0][0] - now)
        return max(0, min(waits))

    def close(self) -> None:
        """Leave for good."""
        self.unplug()


class EmulatedPort(BoardLine):
    """A serial port with a stable name.

    Raises:
        FileExistsError: another emulator serves ``link``, or something that is not a symbolic link
            stands there.
    """

    def __init__(self, link: str, baud_rate: int) -> None:
        super().__init__(link, baud_rate)
        self._path = Path(link)
        self._master: int | None = None
        self._claim()
        self.plug()

    def _claim(self) -> None:
        """Keep other emulators from this link; the kernel lets go of it with the process."""
        self._claim_path = self._path.with_name(f"{self._path.name}.lock")
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
        if self._path.exists() and not self._path.is_symlink():
            raise FileExistsError(
                f"{self.link} is in the way: remove it, or set the parameter 'port_link'"
            )
        master, slave = pty.openpty()
        tty.setraw(slave)
        device = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(master, False)
        temporary = self._path.with_name(f"{self._path.name}.{os.getpid()}")
        temporary.symlink_to(device)
        temporary.replace(self._path)
        self._master = master

    def unplug(self) -> None:
        """Disappear, and the stable name as well."""
        super().unplug()
        if self._master is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._master)
            self._master = None

    def watched(self) -> list[int]:
        """Return the descriptors to wait for; empty while no host has the port open."""
        return [] if self._master is None or not self.host_present else [self._master]

    def read(self, now: int) -> bool:
        """Take what the host has sent, as of now [ns]; return whether it just opened the port."""
        if self._master is None:
            return False
        was_present, self.host_present = self.host_present, True
        try:
            self._take(os.read(self._master, 4096), now)
        except BlockingIOError:
            pass
        except OSError:  # nobody has the other end open
            self.host_present = False
        return self.host_present and not was_present

    def _write(self, data: bytes) -> int:
        assert self._master is not None
        return os.write(self._master, data)

    def close(self) -> None:
        """Remove the port for good."""
        self.unplug()
        with contextlib.suppress(OSError):
            self._claim_path.unlink()
            os.close(self._claim_file)


class BoardSocket(BoardLine):
    """A board in a network: what an emulated board and `topic_board` listen with.

    Bytes cost no time. The newest connection counts: whoever makes it has to vent. Nobody restarts
    a board by connecting.

    Args:
        link: `tcp://host:port` to listen at.

    Raises:
        OSError: the address is not this computer's, or another program listens there.
    """

    def __init__(self, link: str) -> None:
        super().__init__(link)
        self._server: socket.socket | None = None
        self._host: socket.socket | None = None
        self.plug()

    def plug(self) -> None:
        """Listen."""
        if self._server is None:
            self._server = socket.create_server(tcp_address(self.link))
            self._server.setblocking(False)

    def unplug(self) -> None:
        """Reset the connection and listen no more."""
        super().unplug()
        for each in (self._server, self._host):
            if each is not None:
                each.close()
        self._server = self._host = None

    def watched(self) -> list[int]:
        """Return the descriptors to wait for."""
        return [each.fileno() for each in (self._server, self._host) if each is not None]

    def read(self, now: int) -> bool:
        """Take what the host has sent, as of now [ns]."""
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
        self.host_present = self._host is not None
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
                self._take(data, now)
            else:
                self._host.close()
                self._host = None

    def _write(self, data: bytes) -> int:
        assert self._host is not None
        return self._host.send(data)


def emulated_line(link: str, baud_rate: int) -> BoardLine:
    """Return the board's end of `tcp://host:port`, or of a serial port with a symbolic link."""
    return BoardSocket(link) if is_tcp(link) else EmulatedPort(link, baud_rate)
