"""What `ros2 run pressure_driver` starts: each function is the process of one node."""

from __future__ import annotations

import contextlib
import os

from limb_interfaces.entry import run_module


def pressure_driver() -> int:
    """Run the driver."""
    _prepare_process()
    return int(run_module("pressure_driver.node"))


def board_emulator() -> int:
    """Run the emulated board."""
    _prepare_process()
    return int(run_module("pressure_driver.emulator.node"))


def _prepare_process() -> None:
    """Have what comes served soon, on busy cores and while other nodes come and go.

    All threads are favoured alike, where that is permitted: one of lower priority may hold a lock.
    Publications are asynchronous unless the user has chosen a mode: `rclpy` holds Python's lock
    while it publishes, and a synchronous publication waits for locks of the middleware.
    """
    with contextlib.suppress(OSError):
        os.nice(-15)
    os.environ.setdefault("RMW_FASTRTPS_PUBLICATION_MODE", "ASYNCHRONOUS")
