"""What `ros2 run apriltag_tracker` starts: each function is the process of one node."""

from __future__ import annotations

from limb_interfaces.entry import run_module


def apriltag_tracker() -> int:
    """Run the tracker."""
    return int(run_module("apriltag_tracker.node"))


def synthetic_camera() -> int:
    """Run the synthetic camera."""
    return int(run_module("apriltag_tracker.synthetic.node"))


def pose_tracker() -> int:
    """Run the tracker of bodies."""
    return int(run_module("apriltag_tracker.bodies.node"))


def synthetic_poses() -> int:
    """Run the simulated motion capture."""
    return int(run_module("apriltag_tracker.synthetic.nodes.poses"))
