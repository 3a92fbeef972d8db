#!/usr/bin/env python3
"""One step of learning from recorded bags."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("der_planner.commands.learn"))
