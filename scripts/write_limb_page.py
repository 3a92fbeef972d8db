#!/usr/bin/env python3
"""Write the page of a limb's parameters from their declaration."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("figures.limb_page"))
