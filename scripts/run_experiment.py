#!/usr/bin/env python3
"""Play motions on the limb or its twin and report the tracking error: the main command.

    python3 scripts/run_experiment.py
    python3 scripts/run_experiment.py --motions all --method optimal --trials 5
    python3 scripts/run_experiment.py --offline --motions all --trials 5
    python3 scripts/run_experiment.py --hardware my_rig.yaml --limb my_limb.yaml

Sets up what is missing first (ROS 2, Python packages, the nodes); --help shows every option.
"""

from __future__ import annotations

import sys

import workspace

workspace.enter()

from orchestrator.errors import GraphError, NodeError  # noqa: E402
from orchestrator.experiment import run  # noqa: E402
from orchestrator.interrupts import interrupt_once  # noqa: E402
from orchestrator.options import OptionError, parse  # noqa: E402


def main() -> int:
    """Run the command line; 0 when every trial was played, 1 after an error, 2 for bad options."""
    interrupt_once()
    try:
        run(parse(sys.argv[1:]))
    except OptionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (GraphError, NodeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        print(f"stopped by {error or 'SIGINT'}; the same --out goes on from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
