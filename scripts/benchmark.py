#!/usr/bin/env python3
"""Measure time and memory of the parts."""

import workspace

if __name__ == "__main__":
    workspace.run("benchmarks.command")
