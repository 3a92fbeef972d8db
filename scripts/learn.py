#!/usr/bin/env python3
"""One step of learning from recorded bags."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.learn")
