"""The ROS domain of this process's tests: tests that run side by side do not hear each other."""

from __future__ import annotations

import os

# 102 to 231 collides with ephemeral ports on Linux; 0 to 20 is where people work.
FIRST, COUNT = 21, 80


def own_domain() -> int:
    """Return TEST_DOMAIN_ID, or a number by the process; workers side by side get neighbours."""
    worker = os.environ.get("PYTEST_XDIST_WORKER")
    session = os.getpid() if worker is None else os.getppid()
    first = int(os.environ.get("TEST_DOMAIN_ID", FIRST + session % COUNT))
    place = 0 if worker is None else int(worker.removeprefix("gw"))
    return FIRST + (first - FIRST + place) % COUNT
