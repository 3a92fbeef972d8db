#!/usr/bin/env python3
"""Publish a recorded bag again."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.replay_bag")
