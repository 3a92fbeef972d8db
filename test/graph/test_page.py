"""The operator's page in a real browser, with a running driver and no planner."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from typing import Any
from urllib.parse import urljoin, urlsplit

import pytest
from browsers import NEEDS_CHROMIUM, signal_browser, start_page, webdriver
from cable import Cable
from driver_bench import Bench

from benchmarks.browser import open_browser
from der_msgs.msg import PressurePlan, PressureState
from limb_interfaces import qos, topics

Keys = webdriver.Keys
pytestmark = [pytest.mark.graph, NEEDS_CHROMIUM]
PRESS = """
const button = document.getElementById(arguments[0]);
if (!window.did_handshake || !button || button.disabled) return false;
button.click();
return true;
"""
LONG_ROWS = """
for (const row of document.querySelectorAll("#nodes tr")) {
  row.firstElementChild.textContent = "/another/limb/apriltag_tracker";
  row.lastElementChild.textContent = "12345.6 s ago";
}
const vent = document.getElementById("vent").getBoundingClientRect();
return [Math.max(vent.right, document.documentElement.scrollWidth), vent.bottom];
"""
BETWEEN = """
const [notices, alarm, bar] = ["notices", "alarm", "bar"].map((id) => document.getElementById(id));
alarm.innerHTML = `<div class="danger">${"The driver is dead. ".repeat(20)}</div>`;
return bar.getBoundingClientRect().top - notices.getBoundingClientRect().bottom;
"""
"""Returns how much of the page is seen beside an alarm [px]."""
HEAR = """
window.heard = [];
const read = (changes) => changes.filter((one) => !one.target.closest("[aria-hidden]"));
new MutationObserver((changes) => heard.push(...read(changes).map((one) => one.target.textContent)))
  .observe(document.getElementById("alarm"), { childList: true, subtree: true });
"""
"""From now on, notes what a screen reader reads aloud of the alarm."""
FOR_EVER = """
const set = window.setTimeout;
window.setTimeout = (action, time) => (time < 30000 ? set(action, time) : 0);
"""
"""No message goes by itself."""


class WatchedPage(Bench):
    """A board, a driver and the page; browsers that look at it."""

    def __init__(self, graph: Any) -> None:
        self.page, self.url = start_page(graph)  # board and driver start meanwhile
        # A limb is held for a minute while somebody watches.
        super().__init__(graph, bounds={}, on_lost_operator="vent", hold_time=60.0)
        self.client.watch([])
        self.browsers: list[Any] = []
        self.client.wait_ready(["page"])

    def open(self, url: str = "") -> Any:
        browser = open_browser()
        self.browsers.append(browser)
        browser.get(url or self.url)
        self.wait(lambda: browser.execute_script("return !!page.data"), "live data")
        self.wait(lambda: browser.find_elements("id", "take"), "the controls")
        return browser


@pytest.fixture(scope="module")
def running(module_graph: Any) -> WatchedPage:
    return WatchedPage(module_graph)


@pytest.fixture
def rig(running: WatchedPage) -> Iterator[WatchedPage]:
    """Board, driver and page of all tests, in the order of this file, without a browser."""
    yield running
    while running.browsers:
        running.browsers.pop().quit()


def enabled(browser: Any, name: str) -> bool:
    script = "return document.getElementById(arguments[0])?.disabled === false;"
    return bool(browser.execute_script(script, name))


def press(rig: WatchedPage, browser: Any, name: str) -> None:
    """Press a button once it is enabled and heard; it may be drawn anew at any time."""
    rig.wait(lambda: browser.execute_script(PRESS, name), f"the button {name}")


def arm(rig: WatchedPage, browser: Any) -> None:
    """Press the button until the driver is armed: it may refuse until the limb has vented."""

    def armed() -> bool:
        browser.execute_script(PRESS, "arm")
        rig.client.spin(0.3)
        return rig.mode == PressureState.ARMED

    rig.wait(armed, "the driver to be armed")
    rig.wait_mode(PressureState.ARMED)


def test_one_arms_and_everybody_vents(rig: WatchedPage) -> None:
    first, second = rig.open(), rig.open()
    assert not enabled(first, "arm")
    press(rig, first, "take")
    arm(rig, first)
    first.refresh()  # the same tab of the same browser: nobody is lost
    rig.wait(lambda: enabled(first, "arm"), "the operator")
    rig.wait(lambda: not enabled(second, "take"), "the second window to see the first one command")
    assert not enabled(second, "arm")

    second.find_element("id", "vent").click()
    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    first.switch_to.active_element.send_keys(" ")  # the arm button has the focus
    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    second.find_element("id", "vent").send_keys(Keys.ENTER)
    rig.wait(lambda: "Vented" in first.find_element("id", "notices").text, "the driver's answer")

    rig.wait_mode(PressureState.DISARMED)
    arm(rig, first)
    signal_browser(first, signal.SIGSTOP)  # as a computer that falls asleep: the connection stays
    rig.wait_mode(PressureState.DISARMED)
    signal_browser(first, signal.SIGCONT)
    press(rig, first, "take")  # which gives up control
    rig.wait(lambda: enabled(second, "take"), "the desk to be free again")
    second.get(urljoin(rig.url, "/setup"))
    arm(rig, second)
    rig.wait(lambda: second.find_element("id", "mode").text == "ARMED", "the page to know")
    press(rig, second, "fill-1-right")
    rig.wait(lambda: min(rig.states[-1].measured_differential) < -3000.0, "the chamber to fill")
    assert abs(rig.states[-1].measured_differential[0]) < 1000.0
    second.find_element("id", "vent").click()  # or it is held, after the browser has gone
    rig.wait_mode(PressureState.DISARMED)


def test_a_telephone_shows_vent_beside_long_rows_and_the_page_beside_an_alarm(
    rig: WatchedPage,
) -> None:
    browser = rig.open()
    telephone = {"width": 320, "height": 568, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", telephone)
    rig.wait(lambda: browser.find_elements("css selector", "#nodes td"), "the nodes")
    right, bottom = browser.execute_script(LONG_ROWS)
    assert (right <= 320, bottom <= 568) == (True, True)
    at_fourfold_zoom = {**telephone, "height": 190}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", at_fourfold_zoom)
    assert browser.execute_script(BETWEEN) > 60


def hold(rig: WatchedPage, browser: Any) -> None:
    """Arm and play, and leave the limb held under pressure by an operator whom the driver knows."""
    rig.wait(lambda: enabled(browser, "arm"), "the desk, which is kept")
    arm(rig, browser)

    def heard() -> bool:  # on a busy machine, setpoints may come too late
        rig.play(10, lambda k: (min(900.0 * (k + 1), 6000.0), 0.0))
        return rig.mode in (PressureState.TRACKING, PressureState.HOLDING)

    rig.wait(heard, "the driver to play")
    rig.wait_mode(PressureState.HOLDING)
    # A driver that has just been started may hear of the services before it hears of the leases.
    known = rig.client.diagnostic_values
    rig.wait(lambda: known("pressure_driver")["operators"] != "none", "the operator to be known")


def lost_operators(rig: WatchedPage) -> int:
    return int(rig.driver.log.read_text().count("is lost"))


def test_a_limb_whose_cable_to_the_operator_is_pulled_is_vented(rig: WatchedPage) -> None:
    port = urlsplit(rig.url).port
    cable, lost = Cable(port), lost_operators(rig)
    try:
        browser = rig.open(rig.url.replace(f":{port}", f":{cable.port}"))
        press(rig, browser, "take")
        hold(rig, browser)
        cable.pull()
        rig.wait_mode(PressureState.DISARMED)
        assert lost_operators(rig) > lost
        cable.plug()
        press(rig, browser, "take")  # which gives up control
        rig.wait(lambda: not enabled(browser, "arm"), "the desk to be free again")
    finally:
        cable.close()


def test_what_died_is_not_shown_as_live_and_a_page_that_hangs_or_dies_vents(
    rig: WatchedPage,
) -> None:
    browser = rig.open()

    def wait(script: str, what: str) -> None:
        rig.wait(lambda: browser.execute_script(f"return {script}"), what)

    def row(node: str) -> str:
        return f"document.querySelector('[data-node={node}]').textContent"

    def notice(words: str) -> str:
        return f"document.getElementById('notices').textContent.includes('{words}')"

    old = "document.getElementById('summary').classList.contains('old')"
    lost = "document.body.classList.contains('lost')"
    wait(f"!{old}", "the driver's state")
    plans = rig.client.node.create_publisher(PressurePlan, topics.PLAN, qos.LATCHED)
    plans.publish(PressurePlan(motion="odd", tip_reference=[0.1, 0.2, 0.3]))
    wait(f"{row('page')}.includes('could not be used')", "the page to say so")
    rig.driver.signal(signal.SIGSTOP)
    wait(old, "the driver's silence")
    assert "ago" in browser.find_element("id", "meaning").text
    assert browser.find_element("id", "mode").text == "NOT KNOWN"
    browser.execute_script(FOR_EVER)
    browser.find_element("id", "vent").click()
    wait(notice("VENT NOT CONFIRMED"), "what to do meanwhile")
    wait(notice("VENT FAILED"), "the failure to show")
    rig.driver.signal(signal.SIGCONT)
    wait(f"!{old}", "the driver's state again")
    wait("document.getElementById('vent-notice').hidden", "a failure that is none any more to go")
    rig.driver.signal(signal.SIGKILL)
    wait(old, "the driver's death")
    wait(notice("The driver is dead: its process has ended"), "the alarm to say why")
    assert browser.title.startswith("ALARM: ")
    wait(notice("--params-file"), "the command that starts it again")
    assert "limb was without pressure, in mode disarmed" in browser.find_element("id", "alarm").text
    browser.find_element("id", "vent").click()
    wait(notice("VENT FAILED"), "the failure to show")

    assert not browser.execute_script(f"return {lost}")
    rig.start_driver()
    rig.client.watch([])
    press(rig, browser, "take")
    for number in (signal.SIGSTOP, signal.SIGKILL):
        hold(rig, browser)
        rig.page.signal(number)
        rig.wait_mode(PressureState.DISARMED)
        wait(f"{lost} && {notice('No connection')}", "the lost connection")
        if number == signal.SIGSTOP:
            rig.page.signal(signal.SIGCONT)
            wait(f"!{lost}", "the server again")
    assert lost_operators(rig) >= 2
    browser.execute_script(HEAR)
    # As after an hour's sleep, during which the steady clock stands still.
    browser.execute_script("const now = Date.now; Date.now = () => now() + 3600e3;")
    wait(notice("for 36"), "the age to show it")
    assert browser.execute_script("return heard") == []  # an alarm is not read anew for its age
