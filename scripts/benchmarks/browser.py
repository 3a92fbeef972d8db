"""The machine's Chromium, without a window on the screen: for benchmarks, pictures and tests."""

from __future__ import annotations

import shutil
from typing import Any

CHROMIUM, CHROMEDRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--window-size=1280,900",
)  # fmt: skip


def open_browser(*flags: str) -> Any:
    """Start it with further flags."""
    from selenium import webdriver  # noqa: PLC0415 - only tests and benchmarks need it

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, *flags):
        options.add_argument(flag)
    window = webdriver.Chrome(options=options, service=webdriver.ChromeService(CHROMEDRIVER))
    window.set_script_timeout(90)
    return window
