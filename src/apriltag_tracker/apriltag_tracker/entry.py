"""What `ros2 run apriltag_tracker` starts: each is the process of one node."""

from __future__ import annotations

from functools import partial

from limb_interfaces.entry import run_module

apriltag_tracker = partial(run_module, "apriltag_tracker.node")
synthetic_camera = partial(run_module, "apriltag_tracker.synthetic.nodes.camera")
pose_tracker = partial(run_module, "apriltag_tracker.bodies.node")
synthetic_poses = partial(run_module, "apriltag_tracker.synthetic.nodes.poses")
