"""Draw the pictures of src/der_planner/doc/page.md: the page on a twin, in the machine's Chromium.

python3 scripts/draw_figures.py page [FOLDER]
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any
from urllib.parse import quote

from benchmarks.page.rig import Rig, running
from der_msgs.msg import PressureState
from der_planner.results.outputs import folder_argument
from workspace_setup.basics import ROOT

DOC = ROOT / "src" / "der_planner" / "doc"
DESKTOP = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
TALL = {**DESKTOP, "height": 1080}
TELEPHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
SETTLING = 1.5
"""[s] for a window to lay itself out in another size."""
CENTRE = """
const box = document.getElementById('sketch').getBoundingClientRect();
const [width, height] = page.pictureSize;
const outline = page.region[0];
const top = outline.reduce((best, point) => (point[1] < best[1] ? point : best));
return [box.left + top[0] * box.width / width, box.top + top[1] * box.height / height];
"""
"""Where the reachable region is highest, in the window."""
FILL_IN = """
const field = [...document.querySelectorAll('input')].find((one) => one.ariaLabel === arguments[0]);
field.focus();
field.select();
"""
BAG = "return page.data.nodes.find((node) => node.name === 'recorder').values.bag;"
RING = 17
"""[px] Radius of the drawn ring in the window."""
POINTS = 24


class Camera:
    """Takes pictures of a window.

    Args:
        rig: that runs.
        folder: where the pictures go.
    """

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.rig = rig
        self.window = rig.browse()
        self._folder = folder
        self.resize(DESKTOP)

    def resize(self, screen: dict[str, Any]) -> None:
        """Give the window the size of a screen."""
        self.window.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        self.rig.client.spin(SETTLING)

    def take(self, name: str) -> None:
        """Write what the window shows."""
        self.window.save_screenshot(str(self._folder / name))
        print(self._folder / name, flush=True)

    def wait(self, script: str, what: str) -> Any:
        """Return what a script returns in the window once it is something."""
        return self.rig.wait(lambda: self.window.execute_script(script), what)

    def press(self, name: str) -> None:
        """Press a button when it can be pressed."""
        button = f"document.getElementById('{name}')"
        self.wait(f"return !!{button} && !{button}.disabled", f"the button {name}")
        self.window.execute_script(f"{button}.click()")

    def write(self, label: str, text: str) -> None:
        """Write into the field of a label, in place of what is there."""
        self.window.execute_script(FILL_IN, label)
        self.window.switch_to.active_element.send_keys(text)


def draw_ring(camera: Camera) -> None:
    """Draw a ring where the tip reaches farthest, and wait for its preview."""
    from selenium.webdriver import ActionChains  # noqa: PLC0415 - only this and the tests need it

    camera.press("draw")
    camera.wait("return page.sketch.on && !!page.region", "the reachable region")
    x, y = camera.window.execute_script(CENTRE)
    actions = ActionChains(camera.window, duration=20)
    pointer = actions.w3c_actions.pointer_action
    angles = [2.0 * math.pi * index / POINTS for index in range(POINTS + 1)]
    places = [(int(x + RING * math.cos(a)), int(y + 6 + RING * math.sin(a))) for a in angles]
    pointer.move_to_location(*places[0])
    pointer.pointer_down()
    for place in places[1:]:
        pointer.move_to_location(*place)
    pointer.pointer_up()
    actions.perform()
    camera.wait("return !!page.sketch.preview", "a preview")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", nargs="?", type=folder_argument, default=DOC)
    folder = parser.parse_args().folder
    with running() as rig:
        camera = Camera(rig, folder)
        camera.press("take")
        camera.press("arm")
        draw_ring(camera)
        camera.press("play-drawing")
        rig.wait_mode(PressureState.TRACKING)
        camera.rig.client.spin(6.0)
        camera.take("page_desktop.png")
        camera.resize(TELEPHONE)
        camera.take("page_phone.png")
        camera.resize(TALL)
        camera.press("draw")
        camera.press("stop")
        rig.wait_mode(PressureState.ARMED)
        camera.write("Payload [g]", "20")
        camera.write("Period [s]", "12")
        camera.write("Note for the recording", "20 g at the tip")
        camera.press("record")
        camera.press("play")
        rig.wait_mode(PressureState.TRACKING)
        camera.rig.client.spin(15.0)
        camera.take("page_playing.png")
        camera.press("unrecord")
        camera.resize(DESKTOP)
        bag = camera.wait(
            "return page.data.nodes.find((n) => n.name === 'recorder').values.bag", ""
        )
        camera.window.get(f"{rig.url}setup")
        camera.rig.client.spin(SETTLING)
        camera.take("page_setup.png")
        camera.window.get(f"{rig.url}replay?bag={quote(str(bag), safe='')}")
        camera.wait("return page.replay.frames > 0", "the recording")
        slider = camera.window.find_element("id", "replay-slider")
        for _ in range(70):
            slider.send_keys("\ue014")  # the arrow to the right
        camera.rig.client.spin(2.0 * SETTLING)
        camera.take("page_replay.png")
    return 0
