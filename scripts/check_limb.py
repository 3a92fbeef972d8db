#!/usr/bin/env python3
"""Say from a later run whether a limb file still fits."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.check_limb")
