"""One step of learning from recorded bags: from the runs of a motion to its next plan.

    python3 scripts/learn.py out/bags/run_1 out/bags/run_2 --limb my_limb.yaml --out learned.yaml
    python3 scripts/learn.py out/bags/run_3 --plan learned.yaml --out learned_2.yaml

The bags may come from any recorder that kept the plan, the setpoints and the tracker's states. The
limb is that of --limb, mounted and loaded as the plan in the first bag was, or that of the learned
plan. Exit code 0: there is a plan; 1: no run was used; 2: a file cannot be used.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from der_planner.commands.recorded_plan import check_same, plan_of
from der_planner.control import Learner, LearningError
from der_planner.experiment.learning import about, add_run
from der_planner.experiment.processes import GraphError
from der_planner.limb import LimbError
from der_planner.planning import PlanningError
from der_planner.planning.plan_file import read_plan, write_plan
from der_planner.results import BagError, EvaluationError, load_run
from der_planner.results.outputs import OutputError, check_file


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bags, oldest first")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the next plan")
    base = parser.add_mutually_exclusive_group(required=True)
    base.add_argument("--limb", type=Path, metavar="FILE", help="limb file of the plan in the bags")
    base.add_argument("--plan", type=Path, metavar="FILE", help="learned plan that was played")
    parser.add_argument("--namespace", default="", help="of the limb, where a bag holds several")
    given = parser.parse_args()
    try:
        check_file(given.out)
        runs = [load_run(bag, namespace=given.namespace) for bag in given.bags]
        first = read_plan(given.plan) if given.plan else plan_of(runs[0], given.limb)
        learner = Learner(first)
        for run in runs:
            check_same(first, run)
            add_run(learner, run)
            print(f"{run.description.title}: {_line(learner)}")
        if not any(run.accepted for run in learner.history):
            print("error: no run was used, so nothing was learned", file=sys.stderr)
            return 1
        following = learner.next()
        write_plan(following, given.out, about(learner))
    except (OutputError, BagError, EvaluationError, GraphError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (LearningError, LimbError, PlanningError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(
        f"{given.out}: expected mean error {following.predicted_error * 100:.3f} cm"
        + (f"; stopped: {learner.stopped}" if learner.stopped else "")
    )
    return 0


def _line(learner: Learner) -> str:
    run = learner.history[-1]
    return f"mean error {run.mean_error * 100:.3f} cm; {run.reason}"
