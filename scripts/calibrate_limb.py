#!/usr/bin/env python3
"""Identify a limb and write its limb file."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("der_planner.commands.calibrate_limb"))
