#!/usr/bin/env python3
"""Write the driver's parameter files from their declaration."""

import workspace

if __name__ == "__main__":
    workspace.run("figures.driver_parameters")
