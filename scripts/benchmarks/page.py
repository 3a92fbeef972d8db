"""The operator's page in a real browser: how fast a vent is, and what the page costs."""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks import cpu_time, show
from benchmarks.browser import CHROMEDRIVER, CHROMIUM, open_browser
from benchmarks.driver import Rig, busy_loops
from der_msgs.msg import ChamberPressures, MotionCommand, PressureSetpoint, PressureState
from der_planner.experiment.processes import PAGE_TOKEN, GraphError, GraphSetup
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

DOMAIN = "95"
PATIENCE = 120.0
"""A node or a browser may take this time [s] to start on a loaded machine."""
PERIOD = 50_000_000
"""Time [ns] between two setpoints."""
PRESSURE = 400.0
"""Both segments hold this differential pressure [Pa] when vent is pressed: so little that the
driver lets itself be armed again at once."""
ARRIVING = 5.0
"""A press that is not at the board after this time [s] has not arrived."""
PROGRESS = 20
"""Presses between two lines of progress."""
LISTEN = """
window.presses = [];
const send = window.fetch;
window.fetch = (...all) => {
  if (all[0] === "/vent") window.presses.push(performance.timeOrigin + window.event.timeStamp);
  return send(...all);
};
"""
"""Notes the instant of each press, by the browser's own stamp of the event [ms]."""
COUNTS = "return [page.pictures, page.received, performance.now()];"

SAID = """
const notices = document.getElementById('notices');
window.said = {};
new MutationObserver(() => {
  const now = performance.timeOrigin + performance.now();
  for (const words of ['The driver is dead', 'NOT CONFIRMED']) {
    if (notices.textContent.includes(words)) window.said[words] ??= now;
  }
}).observe(notices, { subtree: true, childList: true, characterData: true });
"""
"""Notes when the window says what it is asked about [ms]."""


class PageGraph(Rig):
    """Board, driver, twin, camera, tracker, planner, recorder and the page, until it is closed.

    Args:
        folder: of logs.
        stack: ends nodes and browsers.
        options: of the `GraphSetup`, such as the twin's seed.
    """

    def __init__(self, folder: Path, stack: contextlib.ExitStack, **options: Any) -> None:
        self._stack = stack
        options = {"metadata": {}, "planner": {}, **options}
        specs = GraphSetup(bag=folder / "bag", page=0, **options).nodes(str(folder / "board"))
        for spec in specs:
            if spec.executable == "page":  # a window whose picture is taken is silent meanwhile
                spec.parameters["lease_period"] = 10.0
        super().__init__(stack, specs, folder)
        self.url = f"{self.client.diagnostic_values('page')['url']}?token={PAGE_TOKEN}"

    def open_window(self) -> Any:
        """Open the page in a browser of its own, and wait until it shows pictures."""
        window = open_browser()
        self._stack.callback(window.quit)
        window.get(self.url)
        shown = "return !!page.data && page.pictures > 0"
        self.wait(lambda: window.execute_script(shown), "the picture in the window")
        return window

    def wait(self, condition: Callable[[], Any], what: str) -> Any:
        """Return what a condition returns once it holds."""
        return self.client.wait_for(condition, PATIENCE, what)

    def wait_mode(self, mode: int) -> None:
        """Wait until the driver says that it is in a mode."""
        del self.states[:]
        self.wait(lambda: self.states and self.states[-1].mode == mode, f"mode {mode}")

    def arm(self) -> None:
        """Arm the driver as soon as it lets itself be armed: chambers take a while to vent."""
        self.graph.arm(PATIENCE)

    def end(self, name: str, number: signal.Signals = signal.SIGKILL) -> None:
        """Kill or stop a node by a signal; from then on nobody expects any to live."""
        self.client.watch(())
        self.graph.processes[name].signal(number)

    def break_board(self, faults: str) -> None:
        """Give the emulated board faults."""
        wanted = [Parameter("faults", value=faults).to_parameter_msg()]
        self.client.ask(SetParameters, "board_emulator/set_parameters", parameters=wanted)

    def measure_cpu(self, seconds: float) -> float:
        """Return the share of a core [%] that the page's process uses during some seconds."""
        page, begin = self.graph.processes["page"], time.monotonic()
        before = cpu_time(page.pid)
        self.client.spin(seconds)
        return 100.0 * (cpu_time(page.pid) - before) / (time.monotonic() - begin)


@contextlib.contextmanager
def page_graph(**options: Any) -> Iterator[PageGraph]:
    """Run the whole graph with the page in a folder of its own; options as of `PageGraph`."""
    os.environ.setdefault("ROS_DOMAIN_ID", DOMAIN)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as stack:
        yield PageGraph(Path(folder), stack, **options)


def send_pressure(publisher: Any, plan_id: str) -> None:
    """Send setpoints of one pressure in both segments, which last beyond the next press."""
    start = (time.time_ns() // PERIOD + 4) * PERIOD
    for index in range(24):
        message = PressureSetpoint(plan_id=plan_id, index=index)
        message.differential_pressure = [PRESSURE, PRESSURE]
        message.header.stamp = stamp_from_nanoseconds(start + index * PERIOD)
        publisher.publish(message)


def first_vent(commands: list[ChamberPressures]) -> ChamberPressures | None:
    """Return the first command to the board that leaves no pressure in a chamber."""
    return next((each for each in commands if np.ptp(each.pressure) < 0.5 * PRESSURE), None)


def measure_vent(graph: PageGraph, window: Any, count: int) -> dict[str, float]:
    """Press vent, by mouse and by space bar in turn; return how many arrived, and when [ms]."""
    window.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": LISTEN})
    window.refresh()
    graph.wait(lambda: window.execute_script("return !!page.data"), "live data")
    publisher = graph.setpoint_publisher()
    random = np.random.default_rng(1)
    taken: list[float] = []
    lost = 0
    while len(taken) + lost < count:
        graph.wait_mode(PressureState.DISARMED)
        while graph.states[-1].commanded_differential[0] != PRESSURE:
            graph.arm()
            send_pressure(publisher, f"vent{time.monotonic()}")
            with contextlib.suppress(GraphError):  # a loaded machine may miss it: once more
                graph.client.wait_for(
                    lambda: graph.states[-1].commanded_differential[0] == PRESSURE, 1.0, "pressure"
                )
        del graph.commands[:]
        graph.client.spin(float(random.uniform(0.0, 0.1)))  # any place between two ticks
        if (len(taken) + lost) % 2:
            window.find_element("tag name", "body").send_keys(" ")
        else:
            window.find_element("id", "vent").click()
        pressed = float(window.execute_script("return window.presses.at(-1);"))
        try:
            vent = graph.client.wait_for(lambda: first_vent(graph.commands), ARRIVING, "the vent")
        except GraphError:
            lost += 1
            graph.client.call("pressure_driver/vent")
            continue
        delay = 1e-6 * nanoseconds(vent.header.stamp) - pressed
        if delay > 0.0:  # else the pressure had ended before the browser was told to press
            taken.append(delay)
            if len(taken) % PROGRESS == 0:
                print(f"  {len(taken)} presses, the largest {max(taken):.1f} ms", flush=True)
    name = "vent_press_to_first_byte_beside_two_busy_loops"
    times = {f"{name}_p{p}_ms": float(np.percentile(taken, p)) for p in (50, 99, 100)}
    return {f"vent_presses_arrived_of_{count}": float(len(taken)), **times}


def measure_alarm(graph: PageGraph, window: Any) -> dict[str, float]:
    """Stop the driver and press vent; return how long the page needs to say either [ms]."""

    def said(words: str, begin: float) -> float:
        script = f"return window.said['{words}']"
        return float(graph.wait(lambda: window.execute_script(script), words)) - begin

    window.execute_script(SAID)
    begin = 1000.0 * time.time()
    graph.end("pressure_driver", signal.SIGSTOP)
    alarmed = said("The driver is dead", begin)
    window.find_element("id", "vent").click()
    pressed = float(window.execute_script("return window.presses.at(-1);"))
    figures = {
        "driver_stopped_to_alarm_ms": alarmed,
        "vent_press_to_not_confirmed_ms": said("NOT CONFIRMED", pressed),
    }
    graph.end("pressure_driver")  # what is stopped would not end in order
    return figures


def measure_windows(graph: PageGraph, windows: list[Any], seconds: float) -> dict[str, float]:
    """Count pictures drawn and live data received by windows, and the page's CPU time."""
    before = [window.execute_script(COUNTS) for window in windows]
    cpu = graph.measure_cpu(seconds)
    rates = []
    for first, window in zip(before, windows, strict=True):
        pictures, received, at = np.subtract(window.execute_script(COUNTS), first)
        rates.append((1000.0 * pictures / at, 1000.0 * received / at))
    return {
        f"windows_{len(windows)}_pictures_per_s_least": min(rate[0] for rate in rates),
        f"windows_{len(windows)}_live_data_per_s_least": min(rate[1] for rate in rates),
        f"windows_{len(windows)}_page_cpu_percent": cpu,
    }


def run(quick: bool) -> dict[str, float]:
    """Measure vent, alarms, rates and CPU, and print each as it comes; ``quick``: ten presses."""
    if not (CHROMIUM and CHROMEDRIVER):
        print("page: not measured: sudo apt-get install chromium chromium-driver")
        return {}
    seconds, presses = (5.0, 10) if quick else (15.0, 100)
    figures: dict[str, float] = {}

    def take(found: dict[str, float]) -> None:
        figures.update(found)
        show(found)

    with page_graph() as graph:
        window = graph.open_window()
        print("  the graph runs, and a window is open", flush=True)
        with busy_loops(2):
            take(measure_vent(graph, window, presses))
        graph.wait_mode(PressureState.DISARMED)
        graph.arm()
        motions = graph.client.node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
        graph.wait(motions.get_subscription_count, "the planner to listen")
        motions.publish(MotionCommand(motion="same_direction", model="der", cycles=5))
        graph.wait_mode(PressureState.TRACKING)
        take(measure_windows(graph, [window], seconds))
        take(measure_windows(graph, [window, graph.open_window()], seconds))
        with busy_loops(2):
            take(measure_alarm(graph, window))
    return figures
