"""What `ros2 run der_planner` starts: each function is the process of one node."""

from __future__ import annotations

from limb_interfaces.entry import run_module


def planner() -> int:
    """Run the planner."""
    return int(run_module("der_planner.nodes.planner"))


def recorder() -> int:
    """Run the recorder."""
    return int(run_module("der_planner.nodes.recorder"))


def limb_twin() -> int:
    """Run the twin of the limb."""
    return int(run_module("der_planner.nodes.limb_twin"))


def page() -> int:
    """Run the operator's page."""
    return run_module("der_planner.page.node")
