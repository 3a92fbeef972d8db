"""The board's end of a line: a pseudo-terminal that behaves as a USB serial port, or `tcp://`."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import socket
import tty
from abc import ABC, abstractmethod
from pathlib import Path
from typing import ClassVar

from pressure_driver.lines import is_tcp, tcp_address


class BoardLine(ABC):
    """A line that can be unplugged. Bytes cost no time.

    Args:
        link: where a driver finds it.
    """

    boots_when_opened: ClassVar[bool]
    """Whether a host that opens the line restarts the board, as where its reset is wired to DTR."""

    def __init__(self, link: str) -> None:
        self.link = link
        self.host_present = False
        """Whether a host has the line open."""

    @abstractmethod
    def plug(self) -> None:
        """Appear, if it is not there."""

    @abstractmethod
    def unplug(self) -> None:
        """Disappear, in the middle of whatever was being said."""

    @abstractmethod
    def watched(self) -> list[int]:
        """Return the descriptors to wait for."""

    @abstractmethod
    def read(self) -> bytes:
        """Take what the host has sent, and see whether it is there."""

    def send(self, data: bytes) -> None:
        """Hand bytes to the host; those that it leaves no room for are lost, as on a real line."""
        if self.host_present and data:
            with contextlib.suppress(OSError):
                self._write(data)

    @abstractmethod
    def _write(self, data: bytes) -> None:
        """Hand bytes to the operating system without waiting."""

    def close(self) -> None:
        """Leave for good."""
        self.unplug()


class EmulatedPort(BoardLine):
    """A serial port with a stable name.

    Raises:
        FileExistsError: another emulator serves ``link``, or something that is not a symbolic link
            stands there.
    """

    boots_when_opened = True

    def __init__(self, link: str) -> None:
        super().__init__(link)
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
        self.host_present = False
        if self._master is not None:
            self._path.unlink(missing_ok=True)
            os.close(self._master)
            self._master = None

    def watched(self) -> list[int]:
        """Return the descriptors to wait for; empty while no host has the port open."""
        return [] if self._master is None or not self.host_present else [self._master]

    def read(self) -> bytes:
        """Take what the host has sent, and see whether it has the port open."""
        if self._master is None:
            return b""
        self.host_present = True
        try:
            return os.read(self._master, 4096)
        except BlockingIOError:
            pass
        except OSError:  # nobody has the other end open
            self.host_present = False
        return b""

    def _write(self, data: bytes) -> None:
        assert self._master is not None
        os.write(self._master, data)

    def close(self) -> None:
        """Remove the port for good."""
        self.unplug()
        with contextlib.suppress(OSError):
            self._claim_path.unlink()
            os.close(self._claim_file)


class BoardSocket(BoardLine):
    """A board in a network: what an emulated board and `topic_board` listen with.

    The newest connection counts: whoever makes it has to vent.

    Args:
        link: `tcp://host:port` to listen at.

    Raises:
        OSError: the address is not this computer's, or another program listens there.
    """

    boots_when_opened = False

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
        self.host_present = False
        for each in (self._server, self._host):
            if each is not None:
                each.close()
        self._server = self._host = None

    def watched(self) -> list[int]:
        """Return the descriptors to wait for."""
        return [each.fileno() for each in (self._server, self._host) if each is not None]

    def read(self) -> bytes:
        """Take what the host has sent, and see whether it is there."""
        data = b""
        with contextlib.suppress(BlockingIOError):
            while self._server is not None:
                host, _ = self._server.accept()
                data += self._hear()
                if self._host is not None:
                    self._host.close()
                self._host = host
                host.setblocking(False)
                host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        data += self._hear()
        self.host_present = self._host is not None
        return data

    def _hear(self) -> bytes:
        """Take what the host has sent, or see that it has gone."""
        data = b""
        if self._host is not None:
            with contextlib.suppress(BlockingIOError):
                with contextlib.suppress(ConnectionError):
                    data = self._host.recv(1 << 16)
                if not data:
                    self._host.close()
                    self._host = None
        return data

    def _write(self, data: bytes) -> None:
        assert self._host is not None
        self._host.send(data)


def emulated_line(link: str) -> BoardLine:
    """Return the board's end of `tcp://host:port`, or of a serial port with a symbolic link."""
    return BoardSocket(link) if is_tcp(link) else EmulatedPort(link)
