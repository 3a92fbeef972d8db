"""The operator's page in a real browser, with a running driver and no planner."""

from __future__ import annotations

import signal
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

import pytest
from browsers import (
    NEEDS_CHROMIUM,
    open_browser,
    signal_browser,
    start_page,
    webdriver,
)

from der_msgs.msg import PressurePlan, PressureState
from limb_interfaces import qos, topics

Keys = webdriver.Keys
pytestmark = [pytest.mark.graph, NEEDS_CHROMIUM]
OLD = """
const watch = arguments[0], done = arguments[arguments.length - 1], begin = performance.now();
const look = () => new Function("return " + watch)()
    ? done((performance.now() - begin) / 1000) : setTimeout(look, 10);
look();
"""
PRESS = """
const button = document.getElementById(arguments[0]);
if (!button || button.disabled) return false;
button.click();
return true;
"""


class WatchedPage:
    """A board, a driver and the page; browsers that look at it."""

    def __init__(self, graph: Any, folder: Path, on_lost_operator: str) -> None:
        self.client = graph.client
        self.folder = folder
        self.browsers: list[Any] = []
        link = f"/tmp/der_limb_page_test_{uuid.uuid4().hex[:8]}"
        self.states: list[Any] = []
        self.client.subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self.states.append)
        graph.start("pressure_driver", "board_emulator", port_link=link)
        self.client.wait_ready(["board_emulator"])
        self.driver = graph.start("pressure_driver", "pressure_driver", port=link)
        self.page, self.url = start_page(graph, on_lost_operator=on_lost_operator)
        self.client.wait_ready(["pressure_driver", "page"])

    def open(self) -> Any:
        browser = open_browser(self.folder / f"profile{len(self.browsers)}")
        self.browsers.append(browser)
        browser.get(self.url)
        self.wait(lambda: browser.execute_script("return !!page.data"), "live data")
        self.wait(lambda: browser.find_elements("id", "take"), "the controls")
        return browser

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        return self.client.wait_for(condition, 90.0, what)

    def wait_mode(self, *modes: int) -> None:
        del self.states[:]
        self.wait(lambda: self.states and self.states[-1].mode in modes, f"a mode of {modes}")

    def lose(self, browser: Any, number: int = signal.SIGKILL) -> None:
        """Send a signal to all processes of a browser, and wait until the page misses it."""
        self.browsers.remove(browser)
        signal_browser(browser, number)
        self.wait(
            lambda: self.client.diagnostic_values("page").get("operator") == "no",
            "the page to miss its operator",
        )

    def close(self) -> None:
        for browser in self.browsers:
            browser.quit()


@pytest.fixture
def rig(graph: Any, tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[WatchedPage]:
    running = WatchedPage(graph, tmp_path, getattr(request, "param", "vent"))
    yield running
    running.close()


def enabled(browser: Any, name: str) -> bool:
    script = "return !document.getElementById(arguments[0])?.disabled;"
    return bool(browser.execute_script(script, name))


def press(rig: WatchedPage, browser: Any, name: str) -> None:
    """Press a button once it is enabled; the framework may draw it anew at any time."""
    rig.wait(lambda: browser.execute_script(PRESS, name), f"the button {name}")


def arm(rig: WatchedPage, browser: Any) -> None:
    """Press the button until the driver is armed: it may refuse until the limb has vented."""

    def armed() -> bool:
        browser.execute_script(PRESS, "arm")
        rig.client.spin(0.3)
        return bool(rig.states) and rig.states[-1].mode == PressureState.ARMED

    rig.wait(armed, "the driver to be armed")


def test_one_arms_and_everybody_vents(rig: WatchedPage) -> None:
    first, second = rig.open(), rig.open()
    assert not enabled(first, "arm")
    press(rig, first, "take")
    arm(rig, first)
    first.refresh()  # it is the same tab of the same browser: on_lost_operator=vent does nothing
    rig.wait(lambda: first.find_elements("id", "arm") and enabled(first, "arm"), "the operator")
    rig.wait(lambda: not enabled(second, "take"), "the second window to see the first one command")
    assert not enabled(second, "arm")

    second.find_element("id", "vent").click()
    rig.wait_mode(PressureState.DISARMED, PressureState.VENTING)
    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    first.switch_to.active_element.send_keys(" ")  # the arm button has the focus
    rig.wait_mode(PressureState.DISARMED, PressureState.VENTING)
    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    second.find_element("id", "vent").send_keys(Keys.ENTER)
    rig.wait_mode(PressureState.DISARMED, PressureState.VENTING)
    rig.wait(lambda: "Vented" in first.find_element("id", "notices").text, "the driver's answer")

    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    rig.lose(first, signal.SIGSTOP)  # as a computer that falls asleep: its connection stays open
    rig.wait_mode(PressureState.DISARMED)
    signal_browser(first, signal.SIGKILL)
    rig.wait(lambda: enabled(second, "take"), "the desk to be free again")
    second.get(urljoin(rig.url, "/setup"))
    arm(rig, second)
    rig.wait(lambda: second.find_element("id", "mode").text == "ARMED", "the page to know")
    press(rig, second, "fill-1-right")
    rig.wait(lambda: min(rig.states[-1].measured_differential) < -3000.0, "the chamber to fill")
    assert abs(rig.states[-1].measured_differential[0]) < 1000.0


@pytest.mark.parametrize("rig", ["continue"], indirect=True)
def test_what_died_is_not_shown_as_live(rig: WatchedPage) -> None:
    operator, browser = rig.open(), rig.open()
    press(rig, operator, "take")
    arm(rig, operator)
    rig.wait(lambda: rig.client.diagnostic_values("page")["operator"] == "yes", "the operator")
    rig.lose(operator)
    rig.wait(lambda: enabled(browser, "take"), "the desk to be free again")
    rig.wait_mode(PressureState.ARMED)  # nothing but the browser ends with it
    old = "document.getElementById('summary').classList.contains('old')"
    lost = "document.body.classList.contains('lost')"
    rig.wait(lambda: not browser.execute_script(f"return {old}"), "the driver's state")
    plans = rig.client.node.create_publisher(PressurePlan, topics.PLAN, qos.LATCHED)
    plans.publish(PressurePlan(motion="odd", tip_reference=[0.1, 0.2, 0.3]))
    said = "return document.querySelector('[data-node=page]').textContent"
    rig.wait(lambda: "could not be used" in browser.execute_script(said), "the page to say so")
    goes_silent(rig, browser, rig.driver, old)
    assert "ago" in browser.find_element("id", "faults").text
    rig.driver.signal(signal.SIGCONT)
    rig.wait(lambda: not browser.execute_script(f"return {old}"), "the driver's state again")
    silent_after(browser, rig.driver, signal.SIGKILL, old)
    assert "ago" in browser.find_element("id", "faults").text
    row = "return document.querySelector('[data-node=pressure_driver]').textContent"
    rig.wait(lambda: "its process has ended" in browser.execute_script(row), "its row to say why")
    browser.find_element("id", "vent").click()
    rig.wait(
        lambda: "VENT FAILED" in browser.find_element("id", "notices").text, "the failure to show"
    )

    assert not browser.execute_script(f"return {lost}")
    goes_silent(rig, browser, rig.page, lost)
    rig.wait(
        lambda: "No connection" in browser.find_element("id", "notices").text, "the lost connection"
    )
    rig.page.signal(signal.SIGCONT)
    rig.wait(lambda: not browser.execute_script(f"return {lost}"), "the server again")
    silent_after(browser, rig.page, signal.SIGKILL, lost)
    rig.wait(
        lambda: "No connection" in browser.find_element("id", "notices").text, "the lost connection"
    )
    # As after an hour's sleep, during which the steady clock stands still.
    browser.execute_script("const now = Date.now; Date.now = () => now() + 3600e3;")
    rig.wait(lambda: "for 36" in browser.find_element("id", "notices").text, "the age to show it")


def silent_after(browser: Any, process: Any, number: int, shown: str) -> float:
    """Send a signal to a process; return the time until the window shows it [s]."""
    sent = time.monotonic()
    process.signal(number)
    browser.execute_async_script(OLD, shown)
    return time.monotonic() - sent


def goes_silent(rig: WatchedPage, browser: Any, process: Any, shown: str) -> None:
    """Stop a process; a second later at most, the window shows it.

    A browser that other programs keep waiting may break this promise a few times, not always.
    """
    took = [silent_after(browser, process, signal.SIGSTOP, shown)]
    while took[-1] > 1.0:
        assert len(took) < 8, took
        process.signal(signal.SIGCONT)
        rig.wait(lambda: not browser.execute_script(f"return {shown}"), "live data again")
        took.append(silent_after(browser, process, signal.SIGSTOP, shown))
