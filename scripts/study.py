#!/usr/bin/env python3
"""Play a study: a table of many runs, on all cores of this machine or on a Dask cluster."""

import workspace

if __name__ == "__main__":
    workspace.run("der_planner.commands.study")
