"""Finds the tip and the shape of a soft limb from the AprilTags on it.

Each function is the process of one node, which `ros2 run apriltag_tracker` starts.
"""

from limb_interfaces.entry import run_module


def apriltag_tracker() -> int:
    """Run the tracker."""
    return int(run_module("apriltag_tracker.node"))


def synthetic_camera() -> int:
    """Run the synthetic camera."""
    return int(run_module("apriltag_tracker.synthetic.node"))
