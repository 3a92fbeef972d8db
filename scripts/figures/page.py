"""Film a run on the twin, and take the page's pictures while it plays, in the machine's Chromium.

python3 scripts/draw_figures.py page [FOLDER] [--states]
"""

from __future__ import annotations

import argparse
import math
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

from PIL import Image

from benchmarks.page import PageGraph, page_graph
from der_msgs.msg import PressureState
from der_planner.results import evaluate_run, format_table, load_run, summarise
from der_planner.results.overlay import write_video
from workspace_setup.basics import ROOT

DOC = ROOT / "docs" / "pictures"
DESKTOP = {"width": 1280, "height": 800, "deviceScaleFactor": 1, "mobile": False}
TABLET = {"width": 820, "height": 1180, "deviceScaleFactor": 1, "mobile": True}
TELEPHONE = {"width": 390, "height": 844, "deviceScaleFactor": 2, "mobile": True}
SCREENS = {"desktop": DESKTOP, "tablet": TABLET, "phone": TELEPHONE}
NO_DITHER = Image.Dither.NONE
SETTLING = 1.5
"""[s] for a window to lay itself out in another size."""
CENTRE = """
const box = document.getElementById('drawing').getBoundingClientRect();
const [width, height] = page.pictureSize;
const top = page.drawing.region[0].reduce((best, point) => (point[1] < best[1] ? point : best));
return [box.left + top[0] * box.width / width, box.top + top[1] * box.height / height];
"""
"""Where the reachable region is highest, in the window."""
LIVE = "return !document.body.matches('.lost') && !document.querySelector('#view.old-title')"
EIGHT = (100, 11, 330)
"""[px] Half width and half height of the drawn eight, and radius of what it lies along."""
POINTS = 48
LIMB = ROOT / "docs" / "tutorials" / "seed_3.yaml"
"""Identified on the twin of seed 3."""


class Photographer:
    """Takes pictures of a window.

    Args:
        graph: that runs.
        folder: where the pictures go.
    """

    def __init__(self, graph: PageGraph, folder: Path) -> None:
        self.graph = graph
        self.window = graph.open_window()
        self._folder = folder
        self.resize(DESKTOP)

    def resize(self, screen: dict[str, Any]) -> None:
        """Give the window the size of a screen, and a finger where it is mobile."""
        touched = {"enabled": screen["mobile"]}
        self.window.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        self.window.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", touched)
        self.graph.client.spin(SETTLING)

    def take(self, name: str, live: bool = True) -> None:
        """Write what the window shows; ``live``: once its data are not old."""
        if live:
            self.wait(LIVE, "live data")
        picture = Image.open(BytesIO(self.window.get_screenshot_as_png()))
        save(picture, self._folder / name)
        print(self._folder / name, flush=True)

    def wait(self, script: str, what: str) -> Any:
        """Return what a script returns in the window once it is something."""
        return self.graph.wait(lambda: self.window.execute_script(script), what)

    def press(self, name: str) -> None:
        """Press a button when it can be pressed."""
        button = f"document.getElementById('{name}')"
        self.wait(f"return !!{button} && !{button}.disabled", f"the button {name}")
        self.window.execute_script(f"{button}.click()")


def save(picture: Image.Image, file: Path) -> None:
    """Write a picture with few colours: the camera's noise makes it large otherwise."""
    few = picture.convert("RGB").quantize(256, Image.Quantize.FASTOCTREE, dither=NO_DITHER)
    few.save(file, optimize=True)


def draw_eight(photographer: Photographer) -> None:
    """Draw a lying eight where the tip reaches farthest, and wait for its preview."""
    from selenium.webdriver import ActionChains  # noqa: PLC0415 - only this and the tests need it

    photographer.press("draw")
    photographer.wait("return page.drawing.on && !!page.drawing.region", "the reachable region")
    x, y = photographer.window.execute_script(CENTRE)
    actions = ActionChains(photographer.window, duration=20)
    pointer = actions.w3c_actions.pointer_action
    half_width, half_height, radius = EIGHT
    angles = [2.0 * math.pi * index / POINTS for index in range(POINTS + 1)]
    eight = [(half_width * math.sin(a), half_height * math.sin(2.0 * a)) for a in angles]
    drop = half_height + radius
    places = [(int(x + u), int(y + v + drop - math.sqrt(radius**2 - u**2))) for u, v in eight]
    pointer.move_to_location(*places[0])
    pointer.pointer_down()
    for place in places[1:]:
        pointer.move_to_location(*place)
    pointer.pointer_up()
    actions.perform()
    photographer.wait("return !!page.drawing.preview", "a preview")


def draw_states(photographer: Photographer) -> None:
    """Show the page in every state of the limb and of the nodes, on every screen."""
    graph, window = photographer.graph, photographer.window

    def take(state: str) -> None:
        for name, screen in SCREENS.items():
            photographer.resize(screen)
            photographer.take(f"page_{state}_{name}.png", live=state != "page_dead")
        photographer.resize(DESKTOP)

    def says(words: str) -> None:
        photographer.wait(
            f"return document.getElementById('notices').textContent.includes('{words}')", words
        )

    photographer.press("take")
    take("disarmed")
    graph.arm()
    take("armed")
    photographer.press("play")
    graph.wait_mode(PressureState.TRACKING)
    graph.client.spin(6.0)
    take("playing")
    window.find_element("id", "vent").click()
    graph.wait_mode(PressureState.DISARMED)
    take("vented")
    graph.arm()
    graph.break_board("supply:105000")
    graph.wait_mode(PressureState.FAULT)
    take("fault")
    graph.end("pressure_driver")
    says("The driver is dead")
    take("driver_dead")
    graph.end("page")
    says("No connection")
    take("page_dead")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=DOC)
    parser.add_argument("--states", action="store_true", help="every state on every screen instead")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    planner = {"limb_file": str(LIMB)}
    with page_graph(seed=3, planner=planner, record_images=not given.states) as graph:
        photographer = Photographer(graph, given.folder)
        if given.states:
            draw_states(photographer)
            return 0
        press = photographer.press
        press("take")
        press("arm")
        draw_eight(photographer)
        bag = graph.client.call("recorder/start")
        press("play")
        graph.wait_mode(PressureState.TRACKING)
        graph.client.spin(6.0)
        photographer.take("page_desktop.png")
        photographer.resize(TELEPHONE)
        photographer.take("page_phone.png")
        photographer.resize(DESKTOP)
        photographer.window.get(urljoin(graph.url, "/setup"))
        graph.client.spin(SETTLING)
        photographer.take("page_setup.png")
        graph.wait_mode(PressureState.ARMED)
        graph.client.call("recorder/stop")
        run = load_run(Path(bag))
        print(format_table(summarise([evaluate_run(run)])))
        print(write_video(run, given.folder / "run.webp"))
    return 0
