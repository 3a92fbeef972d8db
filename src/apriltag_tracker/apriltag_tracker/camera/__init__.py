"""Cameras: projection and its inverse, calibration, encodings and sources of images."""

from apriltag_tracker.camera.pinhole import CameraError, CameraPose, Intrinsics, project, solve_pose

__all__ = ["CameraError", "CameraPose", "Intrinsics", "project", "solve_pose"]
