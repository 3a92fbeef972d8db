"""One module for each part that `benchmark.py` measures; `command` names them."""

from __future__ import annotations

import psutil


def cpu_time(number: int) -> float:
    """Return the user and system time [s] that a process, which runs, has used so far."""
    used = psutil.Process(number).cpu_times()
    return used.user + used.system
