#!/usr/bin/env python3
"""Compute the tracking errors of recorded runs from their bags."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("der_planner.commands.evaluate"))
