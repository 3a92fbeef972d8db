"""What `ros2 run pressure_driver` starts: each function is the process of one node."""

from __future__ import annotations

import os

from limb_interfaces.entry import run_module


def pressure_driver() -> int:
    """Run the driver.

    It publishes asynchronously, unless the user has said otherwise: `rclpy` holds Python's lock
    while it publishes, and a synchronous publication waits for locks of the middleware.
    """
    os.environ.setdefault("RMW_FASTRTPS_PUBLICATION_MODE", "ASYNCHRONOUS")
    return int(run_module("pressure_driver.node"))


def board_emulator() -> int:
    """Run the emulated board."""
    return int(run_module("pressure_driver.emulator.node"))
