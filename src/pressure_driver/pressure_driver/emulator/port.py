"""A pseudo-terminal that behaves as a USB serial port: a stable name, a baud rate, an unplug."""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import pty
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path

_IN_MODIFY = 0x2
"""Of inotify: written to."""
BITS_PER_BYTE = 10
"""Start bit, eight data bits, stop bit."""
LONGEST_READ = 5_000_000
"""[ns] between a wake and the end of its read, above which the bytes are of unknown age."""


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
        self._tap = LineTap(device)
        temporary = self.link.with_name(f"{self.link.name}.{os.getpid()}")
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()
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
        self._tap.close()
        self._master = None
        self.host_present = False
        self._outgoing.clear()
        self._incoming.clear()

    def watched(self) -> list[int]:
        """Return the descriptors to wait for; empty while no host has the port open.

        Where writes can be tapped, the terminal itself is left out: waiting for it would wait for
        the kernel's worker as well.
        """
        if self._master is None or not self.host_present:
            return []
        return [self._tap.descriptor if self._tap.descriptor >= 0 else self._master]

    def read(self, now: int, clock: Callable[[], int] | None = None) -> bool:
        """Take what the host has sent.

        Args:
            now: [ns] wall clock when the wait ended: the arrival of bytes whose writing ended it.
            clock: the wall clock, for the arrival of bytes that were not announced; ``now`` if
                None.

        Returns:
            Whether a host has just opened the port.
        """
        if self._master is None:
            return False
        was_present = self.host_present
        announced = self._tap.take()
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
        arrival = now
        if clock is not None:
            after = clock()
            # If this thread was kept waiting since, bytes may have come after the announced ones.
            arrival = now if announced and after - now < LONGEST_READ else after
        first = max(arrival, self._line_free)
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


class LineTap:
    """Tells at once of writes to a device; does nothing where there is no inotify.

    The kernel hands bytes to the other end of a pseudo-terminal by a worker of ordinary priority,
    which on busy cores comes milliseconds later; a real serial port begins to send at once. The
    event of inotify is raised within the host's own write.

    Args:
        device: path of the host's end of a pseudo-terminal.
    """

    def __init__(self, device: str) -> None:
        self._descriptor = -1
        library = ctypes.CDLL(None, use_errno=True)
        descriptor = library.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
        if descriptor < 0:
            return
        if library.inotify_add_watch(descriptor, os.fsencode(device), _IN_MODIFY) < 0:
            os.close(descriptor)
            return
        self._descriptor = descriptor

    @property
    def descriptor(self) -> int:
        """File descriptor that becomes readable with a write; −1 where there is none."""
        return self._descriptor

    def take(self) -> bool:
        """Return whether there has been a write since the last call."""
        if self._descriptor < 0:
            return False
        with contextlib.suppress(BlockingIOError):
            return bool(os.read(self._descriptor, 4096))
        return False

    def close(self) -> None:
        """Stop watching."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1
