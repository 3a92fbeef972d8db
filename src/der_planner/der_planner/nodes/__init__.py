"""The nodes, and what `ros2 run der_planner` starts: each function is the process of one of them.

A node's module is loaded only then: signals end the process quietly while it loads.
"""

from limb_interfaces.entry import run_module


def run_planner() -> int:
    """Run the planner."""
    return run_module("der_planner.nodes.planner")


def run_recorder() -> int:
    """Run the recorder."""
    return run_module("der_planner.nodes.recorder")


def run_limb_twin() -> int:
    """Run the twin of the limb."""
    return run_module("der_planner.nodes.limb_twin")


def run_page() -> int:
    """Run the operator's page."""
    return run_module("der_planner.page.node")
