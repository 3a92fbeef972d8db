#!/usr/bin/env python3
"""Compile the kernels of planner, twin, camera and tracker, as the set-up does."""

import argparse
import sys

import workspace

if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    sys.exit(workspace.run("workspace_setup.kernels"))
