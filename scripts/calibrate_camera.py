#!/usr/bin/env python3
"""Calibrate the camera, or the mounting of the tags."""

import workspace

if __name__ == "__main__":
    workspace.run("apriltag_tracker.commands.calibrate_camera")
