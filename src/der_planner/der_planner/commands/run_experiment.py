"""Play motions on the limb or its twin and report the tracking error: the main command.

    python3 scripts/run_experiment.py
    python3 scripts/run_experiment.py --motions all --method optimal --trials 5
    python3 scripts/run_experiment.py --offline --motions all --trials 5
    python3 scripts/run_experiment.py --hardware my_rig.yaml --limb my_limb.yaml

Sets up what is missing first (ROS 2, Python packages, the nodes); --help shows every option.
"""

from __future__ import annotations

import sys

from der_planner.experiment.console import OptionError, interrupt_once
from der_planner.experiment.experiment import run
from der_planner.experiment.options import parse
from der_planner.experiment.processes import GraphError, NodeError
from der_planner.results.outputs import OutputError


def main() -> int:
    """Run the command line; 0 when every trial was played, 1 after an error, 2 for bad options."""
    try:
        options = parse(sys.argv[1:])
        if not options.offline:
            interrupt_once()
        run(options)
    except (OptionError, OutputError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (GraphError, NodeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as error:
        print(f"stopped by {error or 'SIGINT'}; the same --out goes on from here", file=sys.stderr)
        return 130
    return 0
