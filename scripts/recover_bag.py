#!/usr/bin/env python3
"""Repair bags that a kill or a full disk left without their index."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("der_planner.bags.recover"))
