#!/usr/bin/env python3
"""Estimate the motion of a recorded run, and what its model lacks, from its bag."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.estimate")
