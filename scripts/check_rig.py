#!/usr/bin/env python3
"""Find how a rig is put together: hoses, sensors, lags, the order of tags or bodies."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.check_rig")
