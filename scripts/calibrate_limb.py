#!/usr/bin/env python3
"""Identify a limb and write its limb file."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.calibrate_limb")
