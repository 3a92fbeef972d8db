"""A whole graph with the operator's page, and real browsers that look at it."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import shutil
import socket
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect
from websockets.typing import Origin

from der_msgs.msg import ChamberPressures, PressureState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.processes import GraphError, NodeProcess
from limb_interfaces import qos, topics

DOMAIN = int(os.environ.get("ROS_DOMAIN_ID") or 95)
PATIENCE = 120.0
"""[s] for a node or a browser to start on a loaded machine."""
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip


SHOWN = 740
"""[px] Width at which a window of 1280 x 800 shows the picture."""


class BrowserError(RuntimeError):
    """There is no Chromium, or nothing that drives it."""


class Rig:
    """Board, driver, twin, camera, tracker, planner, recorder, and the page if it is wanted.

    Args:
        folder: of logs and profiles.
        with_page: whether the page runs.
    """

    def __init__(self, folder: Path, with_page: bool = True) -> None:
        self._folder = folder
        self._stack = contextlib.ExitStack()
        self._browsers = 0
        self.client = self._stack.enter_context(GraphClient("benchmark", DOMAIN))
        self.commands: list[ChamberPressures] = []
        self.states: list[PressureState] = []
        self.processes: dict[str, NodeProcess] = {}
        subscribe = self.client.subscribe
        subscribe(ChamberPressures, topics.TWIN_BOARD_COMMANDS, qos.SETPOINTS, self.commands.append)
        subscribe(PressureState, topics.PRESSURE_STATE, qos.STATES, self.states.append)
        port = str(folder / "board")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.url = f"http://127.0.0.1:{free.getsockname()[1]}/"
        nodes: list[tuple[str, str, dict[str, object]]] = [
            ("pressure_driver", "board_emulator", {"port_link": port}),
            ("pressure_driver", "pressure_driver", {"port": port}),
            ("der_planner", "limb_twin", {}),
            ("apriltag_tracker", "synthetic_camera", {}),
            ("apriltag_tracker", "apriltag_tracker", {}),
            ("der_planner", "planner", {}),
            ("der_planner", "recorder", {"output": str(folder / "bag")}),
        ]
        if with_page:
            page_port = int(self.url.rsplit(":", 1)[1].strip("/"))
            nodes.append(("der_planner", "page", {"port": page_port}))
        try:
            for package, executable, parameters in nodes:
                self._start(package, executable, parameters)
                if executable == "board_emulator":
                    self.client.wait_for(lambda: os.path.lexists(port), PATIENCE, "the port")
            self.client.wait_ready(self.processes)
        except BaseException:
            self.close()
            raise

    def _start(self, package: str, executable: str, parameters: dict[str, object]) -> None:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(DOMAIN)}
        process = NodeProcess(
            package, executable, parameters, self._folder, None, environment, executable
        )
        self.processes[executable] = process
        self._stack.callback(process.stop)
        self.client.watch(self.processes.values())

    def browse(self, niceness: int = 0) -> Any:
        """Open a window of a new browser on the page; returns its driver.

        Args:
            niceness: of all its processes; 19 lets all others go first.

        Raises:
            BrowserError: selenium, Chromium or chromedriver is missing.
        """
        chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
        try:
            from selenium import webdriver  # noqa: PLC0415 - only tests and this need it
        except ImportError as error:
            raise BrowserError(
                "selenium is missing: it is among the packages of the tests"
            ) from error
        if not (chromium and driver):
            raise BrowserError(
                "no Chromium to open the page with: sudo apt-get install chromium chromium-driver"
            )
        options = webdriver.ChromeOptions()
        options.binary_location = chromium
        self._browsers += 1
        profile = self._folder / f"profile{self._browsers}"
        for flag in (*FLAGS, f"--user-data-dir={profile}", "--window-size=1280,800"):
            options.add_argument(flag)
        starter = self._folder / f"browser{self._browsers}"
        starter.write_text(f'#!/bin/sh\nexec nice -n {niceness} "{driver}" "$@"\n')
        starter.chmod(0o755)
        service = webdriver.ChromeService(str(starter))
        window = webdriver.Chrome(options=options, service=service)
        self._stack.callback(window.quit)
        window.set_script_timeout(PATIENCE)
        window.get(self.url)
        self.wait(lambda: window.execute_script("return !!page.data && page.pictures > 0"), "data")
        return window

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        """Return what a condition returns once it holds."""
        return self.client.wait_for(condition, PATIENCE, what)

    def wait_mode(self, *modes: int) -> None:
        """Wait until the driver says that it is in one of some modes."""
        del self.states[:]
        self.wait(lambda: self.states and self.states[-1].mode in modes, f"a mode of {modes}")

    def arm(self) -> None:
        """Arm the driver as soon as it lets itself be armed: chambers take a while to vent."""

        def armed() -> bool:
            try:
                self.client.call("pressure_driver/arm", 20.0)
            except GraphError:
                self.client.spin(0.2)
                return False
            return True

        self.wait(armed, "the driver to be armed")

    def view(self) -> Viewer:
        """Begin to take what a window would take, without a browser that draws it."""
        viewer = Viewer(self.url)
        self._stack.callback(viewer.close)
        return viewer

    def cpu(self, seconds: float, name: str = "page") -> float:
        """Return the share of a core [%] that a node's process uses during some seconds."""
        before, begin = self.processes[name].measure_cpu(), time.monotonic()
        self.client.spin(seconds)
        used = self.processes[name].measure_cpu() - before
        return 100.0 * used / (time.monotonic() - begin)

    def memory(self, name: str = "page") -> float:
        """Return the resident memory of a node's process [MB]."""
        status = Path(f"/proc/{self.processes[name].pid}/status").read_text()
        line = next(line for line in status.splitlines() if line.startswith("VmRSS:"))
        return int(line.split()[1]) / 1000.0

    @staticmethod
    def heap(window: Any) -> float:
        """Return what the scripts of a window have in memory [MB]; NaN if it does not answer."""
        from selenium.common.exceptions import TimeoutException  # noqa: PLC0415 - as in `browse`

        try:
            return float(window.execute_script("return performance.memory.usedJSHeapSize;")) / 1e6
        except TimeoutException:
            return float("nan")

    def close(self) -> None:
        """End the browsers and the nodes."""
        self._stack.close()


class Viewer:
    """Takes pictures and live data as a window does, and counts them; it draws nothing.

    Args:
        url: of the page.
    """

    def __init__(self, url: str) -> None:
        self.pictures = 0
        self.received = 0
        self._host = url.split("//")[1].strip("/")
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=run, daemon=True) for run in (self._look, self._listen)
        ]
        for thread in self._threads:
            thread.start()

    def _look(self) -> None:
        connection, number = http.client.HTTPConnection(self._host, timeout=PATIENCE), 0
        while not self._stop.is_set():
            connection.request("GET", f"/picture?after={number}&wait=1&width={SHOWN}")
            answer = connection.getresponse()
            body = answer.read()
            if answer.status == http.HTTPStatus.OK:
                size = struct.unpack(">I", body[:4])[0]
                number = json.loads(body[4 : 4 + size])["number"]
                self.pictures += 1
        connection.close()

    def _listen(self) -> None:
        origin = Origin(f"http://{self._host}")
        with connect(f"ws://{self._host}/live", origin=origin) as socket:
            while not self._stop.is_set():
                socket.send(str(time.monotonic()))
                socket.recv(timeout=PATIENCE)
                self.received += 1

    def close(self) -> None:
        """Take no more."""
        self._stop.set()
        for thread in self._threads:
            thread.join(timeout=5.0)


@contextlib.contextmanager
def running(with_page: bool = True) -> Iterator[Rig]:
    """Run a rig in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="der_limb_page_") as folder:
        rig = Rig(Path(folder), with_page)
        try:
            yield rig
        finally:
            rig.close()


def report(title: str, figures: dict[str, float]) -> None:
    """Print figures for people."""
    print(f"\n{title}")
    for key, value in figures.items():
        print(f"  {key.replace('_', ' '):52s} {value:10.3f}", flush=True)
