"""A line drawn in a real browser: what it would look like is shown, and the limb follows it."""

from __future__ import annotations

import contextlib
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from browsers import NEEDS_CHROMIUM, signal_browser, start_page, webdriver
from driver_bench import Bench

from benchmarks.browser import open_browser
from der_msgs.msg import PressurePlan, PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.processes import GraphError
from der_planner.limb import Limb
from limb_interfaces import qos, topics

pytestmark = [pytest.mark.graph, pytest.mark.slow, NEEDS_CHROMIUM]
PLACE = """
const canvas = document.getElementById('drawing'), box = canvas.getBoundingClientRect();
const region = page.drawing.region[0];
const right = region.reduce((best, point) => (point[0] > best[0] ? point : best));
const across = box.width / canvas.width, down = box.height / canvas.height;
return [box.left + right[0] * across, box.top + right[1] * down];
"""
"""Where the region is farthest to the right, in the window."""
SELECT = """
const field = [...document.querySelectorAll('input')].find((one) => one.ariaLabel === arguments[0]);
field.focus();
field.select();
"""


@pytest.fixture
def rig(graph: Any, tmp_path: Path) -> tuple[Bench, str]:
    """Start a twin with everything; return the driver's bench and the page's address."""
    graph.start("der_planner", "limb_twin")
    graph.start("apriltag_tracker", "synthetic_camera")
    graph.start("apriltag_tracker", "apriltag_tracker")
    limb_file = tmp_path / "limb.yaml"
    replace(Limb.default(), name="the planner's own").to_yaml(limb_file)
    graph.start("der_planner", "planner", default_method="projected", limb_file=str(limb_file))
    _, url = start_page(graph, drawings=str(tmp_path / "drawings"), lease_period=6.0)
    bench = Bench(graph, bounds={})
    graph.client.wait_ready([process.executable for process in graph.processes])
    return bench, url


@pytest.fixture
def browser(tmp_path: Path) -> Any:
    window = open_browser(f"--user-data-dir={tmp_path}/profile")
    yield window
    with contextlib.suppress(Exception):  # it may have been killed
        window.quit()


def press_enabled(client: GraphClient, browser: Any, name: str) -> None:
    button, why = (browser.find_element("id", each) for each in (name, "why"))
    try:
        client.wait_for(button.is_enabled, 120.0, f"the button {name}")
    except GraphError as error:
        raise AssertionError(f"{error}, which is grey: {why.text}") from error
    browser.execute_script(f"document.getElementById('{name}').click()")


def test_a_drawing_is_previewed_played_and_kept(
    rig: tuple[Bench, str], browser: Any, tmp_path: Path
) -> None:
    (bench, url), client = rig, rig[0].client
    client.subscribe(PressurePlan, topics.PLAN, qos.LATCHED)
    browser.get(url)

    def wait(script: str, what: str) -> Any:
        return client.wait_for(lambda: browser.execute_script(script), 120.0, what)

    press = partial(press_enabled, client, browser)

    limb_drawn = "return page.data.nodes.find((node) => node.own === 'page').values.limb"
    wait(f'{limb_drawn} === "the planner\'s own"', "the page to draw with the planner's limb")
    wait("return page.pictures > 0 && !!document.getElementById('draw')", "pictures")
    press("take")

    def armed() -> bool:  # it may refuse at first: a board's report that is late, for instance
        browser.execute_script("document.getElementById('arm').click()")
        client.spin(0.5)
        return bool(bench.mode == PressureState.ARMED)

    client.wait_for(armed, 60.0, "the driver to be armed")
    press("draw")
    wait("return page.drawing.on && !!page.drawing.region", "the reachable region")
    x, y = browser.execute_script(PLACE)
    actions = webdriver.ActionChains(browser, duration=20)
    pointer = actions.w3c_actions.pointer_action
    pointer.move_to_location(int(x) - 2, int(y) + 20)
    pointer.pointer_down()
    for step in range(12):  # out of the region and back
        pointer.move_to_location(int(x) - 2 + (4 * step if step < 6 else 0), int(y) + 20 - 4 * step)
    pointer.pointer_up()
    actions.perform()
    wait("return !!page.drawing.preview && page.drawing.preview.poses.length > 0", "a preview")
    said = browser.find_element("id", "preview").text
    assert "leaves what the limb reaches" in said
    assert "kPa" in said

    browser.find_element("css selector", ".drawing-name input").send_keys("../hand")
    press("save-drawing")
    client.wait_for((tmp_path / "drawings" / "hand.csv").exists, 60.0, "the kept drawing")
    browser.execute_script(SELECT, "Payload [g]")
    browser.switch_to.active_element.send_keys("20")
    wait("return page.drawing.load.startsWith('payload=0.02&')", "the load to be reckoned with")
    press("play")  # once it is planned anew
    client.wait_for(lambda: topics.PLAN in client.newest, 60.0, "the plan")
    assert client.newest[topics.PLAN].payload == pytest.approx(0.02)
    bench.wait_mode(PressureState.TRACKING)

    slow = {"offline": False, "latency": 600, "downloadThroughput": 5000, "uploadThroughput": 5000}
    browser.execute_cdp_cmd("Network.enable", {})
    browser.execute_cdp_cmd("Network.emulateNetworkConditions", slow)
    wait("return document.querySelector('#view .age').textContent.endsWith('s old')", "the age")
    assert browser.execute_script(
        "return page.data.sources.camera.fresh"
    )  # the way is slow, not it

    signal_browser(browser, signal.SIGKILL)
    bench.wait_mode(PressureState.DISARMED)  # the driver lets the limb down without an operator
    assert "is lost" in bench.driver.log.read_text()
