#!/usr/bin/env python3
"""Measure time and memory of the parts."""

import sys

import workspace

if __name__ == "__main__":
    sys.exit(workspace.run("benchmarks.command"))
