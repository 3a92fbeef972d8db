#!/usr/bin/env python3
"""Say from a later run whether a limb file still fits."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("der_planner.commands.check_limb"))
