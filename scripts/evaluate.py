#!/usr/bin/env python3
"""Compute the tracking errors of recorded runs from their bags."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.evaluate")
