#!/usr/bin/env python3
"""Play motions on the limb or its twin and report the tracking error."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.run_experiment")
