"""One module for each part that `benchmark.py` measures; `command` names them."""

from __future__ import annotations

from collections.abc import Mapping

import psutil


def cpu_time(number: int) -> float:
    """Return the user and system time [s] that a process, which runs, has used so far."""
    used = psutil.Process(number).cpu_times()
    return used.user + used.system


def show(figures: Mapping[str, float | str]) -> None:
    """Print figures, each by its name, at whose end the unit stands."""
    for name, value in figures.items():
        shown = value if isinstance(value, str) else f"{value:.5g}"
        print(f"  {name.replace('_', ' '):60} {shown:>10}", flush=True)
