"""What `ros2 run pressure_driver` starts: each function is the process of one node."""

from __future__ import annotations

import contextlib
import os

from limb_interfaces.entry import run_module


def pressure_driver() -> int:
    """Run the driver.

    It publishes asynchronously, unless the user has said otherwise: `rclpy` holds Python's lock
    while it publishes, and a synchronous publication waits for locks of the middleware. All threads
    of ROS are favoured alike, where that is permitted, so that `vent` comes through on busy cores.
    """
    os.environ.setdefault("RMW_FASTRTPS_PUBLICATION_MODE", "ASYNCHRONOUS")
    with contextlib.suppress(OSError):
        os.nice(-15)
    return int(run_module("pressure_driver.node"))


def board_emulator() -> int:
    """Run the emulated board."""
    return int(run_module("pressure_driver.emulator.node"))
