#!/usr/bin/env python3
"""Publish a recorded bag again."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("der_planner.commands.replay_bag"))
