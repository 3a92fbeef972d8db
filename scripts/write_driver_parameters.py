#!/usr/bin/env python3
"""Write the driver's parameter files from their declaration."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("figures.driver_parameters"))
