"""The operator's page in a real browser, with a running driver and no planner."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from der_msgs.msg import PressureState
from limb_interfaces import qos, topics

webdriver = pytest.importorskip("selenium.webdriver")
CHROMIUM, CHROMEDRIVER = shutil.which("chromium"), shutil.which("chromedriver")
pytestmark = [
    pytest.mark.graph,
    pytest.mark.skipif(
        not (CHROMIUM and CHROMEDRIVER),
        reason="no Chromium to open the page with: sudo apt-get install chromium chromium-driver",
    ),
]
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip
OLD = """
const watch = arguments[0], done = arguments[arguments.length - 1], begin = performance.now();
const look = () => new Function("return " + watch)()
    ? done((performance.now() - begin) / 1000) : setTimeout(look, 10);
look();
"""


class Rig:
    """A board, a driver and the page; browsers that look at it."""

    def __init__(self, graph: Any, folder: Path) -> None:
        self.client = graph.client
        self.folder = folder
        self.browsers: list[Any] = []
        link = f"/tmp/der_limb_page_test_{uuid.uuid4().hex[:8]}"
        self.states: list[Any] = []
        self.client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self.states.append)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{port}/"
        graph.start("pressure_driver", "board_emulator", port_link=link)
        self.client.wait_ready(["board_emulator"])
        self.driver = graph.start("pressure_driver", "pressure_driver", port=link)
        self.page = graph.start("der_planner", "page", port=port, on_lost_operator="vent")
        self.client.wait_ready(["pressure_driver", "page"])

    def open(self) -> Any:
        options = webdriver.ChromeOptions()
        options.binary_location = CHROMIUM
        profile = self.folder / f"profile{len(self.browsers)}"
        for flag in (*FLAGS, f"--user-data-dir={profile}", "--window-size=1280,800"):
            options.add_argument(flag)
        options.set_capability("goog:loggingPrefs", {"performance": "ALL"})
        service = webdriver.ChromeService(CHROMEDRIVER)
        browser = webdriver.Chrome(options=options, service=service)
        browser.set_script_timeout(30)
        self.browsers.append(browser)
        browser.get(self.url)
        self.wait(lambda: browser.execute_script("return !!page.data"), "live data")
        self.wait(lambda: browser.find_elements("id", "take"), "the controls")
        return browser

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        return self.client.wait_for(condition, 30.0, what)

    def wait_mode(self, *modes: int) -> None:
        del self.states[:]
        self.wait(lambda: self.states and self.states[-1].mode in modes, f"a mode of {modes}")

    def close(self) -> None:
        for browser in self.browsers:
            browser.quit()


@pytest.fixture
def rig(graph: Any, tmp_path: Path) -> Iterator[Rig]:
    running = Rig(graph, tmp_path)
    yield running
    running.close()


def enabled(browser: Any, name: str) -> bool:
    return bool(browser.find_element("id", name).is_enabled())


def arm(rig: Rig, browser: Any) -> None:
    rig.wait(lambda: enabled(browser, "arm"), "the arm button")
    browser.find_element("id", "arm").click()
    rig.wait_mode(PressureState.ARMED)


def test_one_arms_and_everybody_vents(rig: Rig) -> None:
    first, second = rig.open(), rig.open()
    assert not enabled(first, "arm")
    first.find_element("id", "take").click()
    arm(rig, first)
    rig.wait(lambda: not enabled(second, "take"), "the second window to see the first one command")
    assert not enabled(second, "arm")

    second.find_element("id", "vent").click()
    rig.wait_mode(PressureState.DISARMED, PressureState.VENTING)
    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    first.switch_to.active_element.send_keys(" ")  # the arm button has the focus
    rig.wait_mode(PressureState.DISARMED, PressureState.VENTING)
    rig.wait(lambda: "Vented" in first.find_element("id", "notice").text, "the driver's answer")

    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    first.get("about:blank")  # the parameter on_lost_operator asks for a vent
    rig.wait_mode(PressureState.DISARMED)
    rig.wait(lambda: enabled(second, "take"), "the desk to be free again")
    hosts = {urlsplit(url).netloc for url in requested(second)}
    assert hosts == {urlsplit(rig.url).netloc}


def requested(browser: Any) -> list[str]:
    """Return the addresses of every request and websocket of a window."""
    found = []
    for entry in browser.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        parameters = message["params"]
        if message["method"] == "Network.requestWillBeSent":
            found.append(parameters["request"]["url"])
        elif message["method"] == "Network.webSocketCreated":
            found.append(parameters["url"])
    return [url for url in found if urlsplit(url).scheme in ("http", "https", "ws", "wss")]


def test_what_died_is_not_shown_as_live(rig: Rig) -> None:
    browser = rig.open()
    old = "document.getElementById('summary').classList.contains('old')"
    lost = "document.body.classList.contains('lost')"
    rig.wait(lambda: not browser.execute_script(f"return {old}"), "the driver's state")
    killed = time.monotonic()
    rig.driver.signal(signal.SIGKILL)
    browser.execute_async_script(OLD, old)
    assert time.monotonic() - killed < 1.0
    assert "ago" in browser.find_element("id", "faults").text
    browser.find_element("id", "vent").click()
    rig.wait(
        lambda: "VENT FAILED" in browser.find_element("id", "notice").text, "the failure to show"
    )

    assert not browser.execute_script(f"return {lost}")
    killed = time.monotonic()
    rig.page.signal(signal.SIGKILL)
    browser.execute_async_script(OLD, lost)
    assert time.monotonic() - killed < 1.0
    assert "No connection" in browser.find_element("id", "notice").text
