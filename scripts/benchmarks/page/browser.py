"""The operator's page in a real browser: how fast a vent is, and what the page costs."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import numpy as np

from benchmarks.driver import PERIOD
from benchmarks.page.rig import BrowserError, Rig, report, running
from der_msgs.msg import ChamberPressures, MotionCommand, PressureSetpoint, PressureState
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

PRESSURE = 2000.0
"""[Pa] that both segments hold when vent is pressed."""
AHEAD = 24
"""Setpoints sent before a press: 1.2 s."""
LISTEN = """
window.presses = [];
const send = window.fetch;
window.fetch = (...all) => {
  if (all[0] === "/vent") window.presses.push(performance.timeOrigin + window.event.timeStamp);
  return send(...all);
};
"""
"""Notes the instant of each press, by the browser's own stamp of the event [ms]."""
NEWEST = "return window.presses ? window.presses.at(-1) : null;"
COUNTS = "return [page.pictures, page.received, performance.now()];"


def _difference(command: ChamberPressures) -> float:
    """Return the largest differential pressure of a command [Pa]."""
    chambers = np.array(command.pressure)
    return float(np.abs(chambers[0::2] - chambers[1::2]).max())


def _hold(rig: Rig, publisher: Any, plan_id: str) -> None:
    """Put both segments under a small pressure that lasts beyond the next press."""
    start = (time.time_ns() // PERIOD + 4) * PERIOD
    for index in range(AHEAD):
        message = PressureSetpoint(
            plan_id=plan_id, index=index, differential_pressure=[PRESSURE, PRESSURE]
        )
        message.header.stamp = stamp_from_nanoseconds(start + index * PERIOD)
        publisher.publish(message)
    del rig.commands[:]
    rig.wait(
        lambda: rig.commands and _difference(rig.commands[-1]) > 0.9 * PRESSURE, "the pressure"
    )


def _press(rig: Rig, window: Any, by_key: bool) -> float:
    """Press vent once; return the time from the browser's event to the board's first byte [s]."""
    begun = 1000.0 * time.time()
    if by_key:
        window.find_element("tag name", "body").send_keys(" ")
    else:
        window.find_element("id", "vent").click()
    newest = rig.wait(
        lambda: (found := window.execute_script(NEWEST)) and found > begun - 50.0 and found,
        "the press",
    )
    pressed = float(newest) / 1000.0

    def vented() -> ChamberPressures | None:
        late = (c for c in rig.commands if nanoseconds(c.header.stamp) * 1e-9 >= pressed)
        return next((c for c in late if _difference(c) < 0.5 * PRESSURE), None)

    return (
        float(nanoseconds(rig.wait(vented, "the vent at the board").header.stamp)) * 1e-9 - pressed
    )


def measure_vent(rig: Rig, window: Any, count: int) -> dict[str, float]:
    """Press vent again and again, by mouse and by space bar in turn."""
    # Also in the page that the framework loads anew after a lost connection.
    window.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": LISTEN})
    window.refresh()
    rig.wait(lambda: window.execute_script("return !!page.data"), "live data")
    publisher = rig.client.node.create_publisher(
        PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINTS
    )
    rig.wait(publisher.get_subscription_count, "the driver to listen")
    random = np.random.default_rng(1)
    taken = []
    for number in range(count):
        rig.wait_mode(PressureState.DISARMED)
        rig.arm()
        rig.wait_mode(PressureState.ARMED)
        _hold(rig, publisher, f"vent{number}")
        rig.client.spin(float(random.uniform(0.0, 0.1)))  # any place between two ticks
        taken.append(1000.0 * _press(rig, window, by_key=number % 2 == 1))
        print(f"  {number + 1}: {taken[-1]:.0f} ms", file=sys.stderr, flush=True)
    print("presses [ms]: " + " ".join(f"{value:.0f}" for value in sorted(taken)), flush=True)
    return {
        "vent_presses": float(count),
        **{f"vent_press_to_first_byte_p{p}_ms": float(np.percentile(taken, p)) for p in (50, 99)},
        "vent_press_to_first_byte_max_ms": float(max(taken)),
    }


def measure_rates(rig: Rig, windows: list[Any], seconds: float) -> dict[str, float]:
    """Count pictures drawn and live data received by browsers, and the page's CPU time."""
    before = [window.execute_script(COUNTS) for window in windows]
    cpu = rig.cpu(seconds)
    after = [window.execute_script(COUNTS) for window in windows]
    rates = [
        [(b - a) / (last[2] - first[2]) * 1000.0 for a, b in zip(first[:2], last[:2], strict=True)]
        for first, last in zip(before, after, strict=True)
    ]
    return _figures(f"windows_{len(windows)}", rates, cpu)


def measure_served(rig: Rig, count: int, seconds: float) -> dict[str, float]:
    """Count what the page sends to viewers that draw nothing, and its CPU time."""
    viewers = [rig.view() for _ in range(count)]
    rig.wait(lambda: all(v.pictures and v.received for v in viewers), "the first pictures")
    before = [(viewer.pictures, viewer.received) for viewer in viewers]
    begin = time.monotonic()
    cpu = rig.cpu(seconds)
    took = time.monotonic() - begin
    rates = [
        [(viewer.pictures - pictures) / took, (viewer.received - received) / took]
        for viewer, (pictures, received) in zip(viewers, before, strict=True)
    ]
    for viewer in viewers:
        viewer.close()
    return _figures(f"served_{count}", rates, cpu)


def _figures(name: str, rates: list[list[float]], cpu: float) -> dict[str, float]:
    return {
        f"{name}_pictures_per_s_least": min(rate[0] for rate in rates),
        f"{name}_live_data_per_s_least": min(rate[1] for rate in rates),
        f"{name}_page_cpu_percent": cpu,
    }


def _move(rig: Rig, cycles: int) -> None:
    """Arm, and have the planner play a motion."""
    rig.wait_mode(PressureState.DISARMED)
    rig.arm()
    publisher = rig.client.node.create_publisher(MotionCommand, topics.COMMAND, qos.COMMANDS)
    rig.wait(publisher.get_subscription_count, "the planner to listen")
    publisher.publish(MotionCommand(motion="same_direction", model="der", cycles=cycles))
    rig.wait_mode(PressureState.TRACKING)


def run(quick: bool) -> dict[str, float]:
    """Measure vent, rates and CPU; ``quick`` presses ten times."""
    seconds = 10.0 if quick else 15.0
    try:
        with running() as rig:
            first = rig.browse()
            print(f"page: vent, load {os.getloadavg()[0]:.1f} …", file=sys.stderr, flush=True)
            figures = measure_vent(rig, first, 10 if quick else 100)
            first.get("about:blank")
            _move(rig, 5)
            for count in (1, 2):
                figures |= measure_served(rig, count, seconds)
            first = rig.browse()
            figures |= measure_rates(rig, [first], seconds)
            figures |= measure_rates(rig, [first, rig.browse()], seconds)
    except BrowserError as error:
        print(f"page: not measured: {error}")
        return {}
    report("the page with one and two windows, served and shown", figures)
    return figures
