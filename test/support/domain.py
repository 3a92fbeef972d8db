"""The ROS domain of a test file, and free ports: tests beside each other do not mix."""

from __future__ import annotations

import os
import socket
import zlib
from pathlib import Path

# 102 to 231 collides with ephemeral ports on Linux; 0 to 20 is where people work.
FIRST, COUNT = 21, 78


def own_domain(file: str | Path) -> int:
    """Return the domain of a test file in this session and worker.

    Files have domains of their own, so that nothing that a test of another file left behind is
    heard, and up to three workers side by side never have the same. TEST_DOMAIN_ID fixes the
    number for all.
    """
    if fixed := os.environ.get("TEST_DOMAIN_ID"):
        return int(fixed)
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    session = os.getpid() if worker is None else os.getppid()
    place = 0 if worker is None else int(worker.removeprefix("gw"))
    return FIRST + (session + 3 * zlib.crc32(Path(file).name.encode()) + place) % COUNT


def free_port() -> int:
    """Return a port of this computer at which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]
