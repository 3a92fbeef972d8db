"""A network cable between a browser and a page, which a test can pull out."""

from __future__ import annotations

import contextlib
import socket
import threading

CHUNK = 1 << 16


class Cable:
    """Forwards TCP connections; while it is pulled out, bytes stay where they are, and none closes.

    Args:
        port: of this machine, where the other end is.
    """

    def __init__(self, port: int) -> None:
        self._far = ("127.0.0.1", port)
        self._plugged = threading.Event()
        self._plugged.set()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        """Where to connect instead."""
        threading.Thread(target=self._accept, daemon=True).start()

    def pull(self) -> None:
        """Let nothing through."""
        self._plugged.clear()

    def plug(self) -> None:
        """Let everything through that has waited, and what follows."""
        self._plugged.set()

    def close(self) -> None:
        """Take no more connections."""
        self._listener.close()
        self.plug()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                self._plugged.wait()
                far = socket.create_connection(self._far)
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._forward, args=ends, daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(CHUNK):
                self._plugged.wait()
                target.sendall(data)
        for end in (source, target):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
