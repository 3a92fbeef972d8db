"""Real browsers for tests of the operator's page."""

from __future__ import annotations

from typing import Any

import psutil
import pytest
from domain import free_port

from benchmarks.browser import CHROMEDRIVER, CHROMIUM

webdriver = pytest.importorskip("selenium.webdriver")
NEEDS_CHROMIUM = pytest.mark.skipif(
    not (CHROMIUM and CHROMEDRIVER),
    reason="no Chromium to open the page with: sudo apt-get install chromium chromium-driver",
)
TOKEN = "token-of-the-tests"


def start_page(graph: Any, **parameters: object) -> tuple[Any, str]:
    """Start the page at a free port; return its process and the address that opens it."""
    port = free_port()
    page = graph.start("der_planner", "page", port=port, token=TOKEN, **parameters)
    return page, f"http://127.0.0.1:{port}/?token={TOKEN}"


def signal_browser(window: Any, number: int) -> None:
    """Send a signal to a browser, its helpers and what drives it."""
    driving = psutil.Process(window.service.process.pid)
    for process in (*driving.children(recursive=True), driving):
        process.send_signal(number)
