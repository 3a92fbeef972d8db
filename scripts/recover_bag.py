#!/usr/bin/env python3
"""Repair bags that a kill or a full disk left without their index."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.bags.recover")
