"""The memory of the operator's page while a window looks and the limb moves."""

from __future__ import annotations

import time

import numpy as np

from benchmarks.page.rig import BrowserError, Rig, report, running
from der_msgs.msg import MotionCommand, PressureState
from limb_interfaces import qos, topics

INTERVAL = 10.0
"""[s] between two looks."""
SETTLING = 180.0
"""[s] that do not count: caches fill."""


def _keep_moving(rig: Rig, publisher: object) -> None:
    """Send a motion again when the one before is over."""
    if not rig.states or rig.states[-1].mode == PressureState.TRACKING:
        return
    if rig.states[-1].mode == PressureState.DISARMED:
        rig.arm()
    publisher.publish(MotionCommand(motion="asynchronous", model="pcc", period=10.0, cycles=1))  # type: ignore[attr-defined]


def run(quick: bool) -> dict[str, float]:
    """Look for 30 minutes, or for five if ``quick``; the growth is a line through what counts."""
    minutes = 5.0 if quick else 30.0
    times, values, window_heaps = [], [], []
    try:
        with running() as rig:
            window = rig.browse()
            publisher = rig.client.node.create_publisher(
                MotionCommand, topics.COMMAND, qos.COMMANDS
            )
            rig.wait(publisher.get_subscription_count, "the planner to listen")
            begin = time.monotonic()
            while time.monotonic() - begin < 60.0 * minutes:
                _keep_moving(rig, publisher)
                del rig.commands[:], rig.states[:]
                rig.client.spin(INTERVAL)
                times.append(time.monotonic() - begin)
                values.append(rig.memory())
                window_heaps.append(rig.heap(window))
                if len(times) % 6 == 0:
                    print(f"  {times[-1] / 60:5.1f} min {values[-1]:8.1f} MB", flush=True)
    except BrowserError as error:
        print(f"page_memory: not measured: {error}")
        return {}
    counted = np.array(times) > SETTLING
    slope = np.polyfit(np.array(times)[counted] / 60.0, np.array(values)[counted], 1)[0]
    third = len(window_heaps) // 3
    figures = {
        "minutes": minutes,
        "page_memory_first_mb": values[0],
        "page_memory_after_settling_mb": float(np.array(values)[counted][0]),
        "page_memory_last_mb": values[-1],
        "page_memory_growth_mb_per_hour": float(60.0 * slope),
        "window_heap_first_third_least_mb": float(np.nanmin(window_heaps[:third])),
        "window_heap_last_third_least_mb": float(np.nanmin(window_heaps[-third:])),
    }
    report("memory of the page's process, and of the window's scripts", figures)
    return figures
