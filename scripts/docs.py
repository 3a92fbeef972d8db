#!/usr/bin/env python3
"""Build the site of docs/: python3 scripts/docs.py [--fresh] [--external] [--graph]."""

import workspace

if __name__ == "__main__":
    workspace.run("documentation.build")
