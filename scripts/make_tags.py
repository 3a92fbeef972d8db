#!/usr/bin/env python3
"""Print sheets of tags or a calibration board in true size."""

import workspace

if __name__ == "__main__":
    workspace.run("apriltag_tracker.commands.make_tags")
