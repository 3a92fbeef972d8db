"""What tests do to real browsers."""

from __future__ import annotations

from typing import Any

import psutil


def signal_browser(window: Any, number: int) -> None:
    """Send a signal to a browser, its helpers and what drives it."""
    driving = psutil.Process(window.service.process.pid)
    for process in (*driving.children(recursive=True), driving):
        process.send_signal(number)
