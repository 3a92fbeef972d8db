"""What `ros2 run pressure_driver` starts: each function is the process of one node."""

from __future__ import annotations

from limb_interfaces.entry import run_module


def pressure_driver() -> int:
    """Run the driver."""
    return int(run_module("pressure_driver.node"))


def board_emulator() -> int:
    """Run the emulated board."""
    return int(run_module("pressure_driver.emulator.node"))
