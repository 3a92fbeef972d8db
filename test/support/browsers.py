"""Real browsers for tests of the operator's page."""

from __future__ import annotations

import shutil
import socket
from pathlib import Path
from typing import Any

import psutil
import pytest

webdriver = pytest.importorskip("selenium.webdriver")
CHROMIUM, CHROMEDRIVER = shutil.which("chromium"), shutil.which("chromedriver")
NEEDS_CHROMIUM = pytest.mark.skipif(
    not (CHROMIUM and CHROMEDRIVER),
    reason="no Chromium to open the page with: sudo apt-get install chromium chromium-driver",
)
TOKEN = "token-of-the-tests"
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=1280,900",
)  # fmt: skip


def start_page(graph: Any, **parameters: object) -> tuple[Any, str]:
    """Start the page at a free port; return its process and the address that opens it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    page = graph.start("der_planner", "page", port=port, token=TOKEN, **parameters)
    return page, f"http://127.0.0.1:{port}/?token={TOKEN}"


def open_browser(profile: Path) -> Any:
    """Start a browser with a profile of its own."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(CHROMEDRIVER))
    browser.set_script_timeout(90)
    return browser


def signal_browser(window: Any, number: int) -> None:
    """Send a signal to a browser, its helpers and what drives it."""
    driving = psutil.Process(window.service.process.pid)
    for process in (*driving.children(recursive=True), driving):
        process.send_signal(number)
