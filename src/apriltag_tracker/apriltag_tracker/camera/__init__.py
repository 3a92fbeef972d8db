"""Cameras: projection and its inverse, calibration, encodings and sources of images."""

from apriltag_tracker.camera.pinhole import (
    PINHOLE_MODELS,
    CameraError,
    CameraPose,
    Intrinsics,
    project,
    solve_pose,
)

__all__ = [
    "PINHOLE_MODELS",
    "CameraError",
    "CameraPose",
    "Intrinsics",
    "project",
    "solve_pose",
]
