#!/usr/bin/env python3
"""Draw the pictures of the documentation pages.

python3 scripts/draw_figures.py {graph,loads,page,planning,rod,tracker} [arguments]
"""

import sys

import workspace

PAGES = ("graph", "loads", "page", "planning", "rod", "tracker")

if __name__ == "__main__":
    if sys.argv[1:] in (["-h"], ["--help"]):
        print(__doc__)
        sys.exit(0)
    if len(sys.argv) < 2 or sys.argv[1] not in PAGES:
        sys.exit(f"usage: draw_figures.py {{{','.join(PAGES)}}} [arguments]")
    workspace.enter()
    workspace.run(f"figures.{sys.argv.pop(1)}")
