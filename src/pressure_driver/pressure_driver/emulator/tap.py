"""Sees at once that a host has written to a pseudo-terminal.

The kernel hands bytes to the other end of a pseudo-terminal by a worker of ordinary priority, which
on busy cores comes milliseconds later; a real serial port begins to send at once. To stamp what is
sent as a real line would, the emulated port watches the device by inotify, whose event is raised
within the host's own write.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys

_IN_MODIFY = 0x2


class LineTap:
    """Tells of writes to a device; does nothing where there is no inotify.

    Args:
        device: path of the host's end of a pseudo-terminal.
    """

    def __init__(self, device: str) -> None:
        self._descriptor = -1
        if sys.platform != "linux":
            return
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
