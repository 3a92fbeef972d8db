"""One step of learning from recorded bags: from the runs of a motion to its next plan.

    python3 scripts/learn.py out/bags/run_1 out/bags/run_2 --limb my_limb.yaml --out learned.yaml
    python3 scripts/learn.py out/bags/run_3 --plan learned.yaml --out learned_2.yaml

The bags may come from any recorder that kept the plan, the setpoints and the tracker's states. The
limb is that of --limb, mounted and loaded as the plan in the first bag was, or that of the learned
plan. Exit code 0: there is a plan; 1: no run was used; 2: a file cannot be used.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np

from der_planner.control import Learner, LearningError
from der_planner.experiment.errors import GraphError
from der_planner.experiment.learning import about, add_run
from der_planner.limb import Limb, LimbError
from der_planner.planning import Motion, Plan, PlanningError, plan
from der_planner.planning.motions import NAMES
from der_planner.planning.plan_file import read_plan, write_plan
from der_planner.runs.evaluation import BagError, EvaluationError, RunSeries, load_run
from der_planner.runs.outputs import OutputError, check_file

_SAME_POINT = 2e-3
"""References whose points lie further apart than this [m] are not of one motion."""


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
        first = read_plan(given.plan) if given.plan else _plan_of(runs[0], given.limb)
        learner = Learner(first)
        for run in runs:
            _check_same(first, run)
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


def _plan_of(run: RunSeries, file: Path) -> Plan:
    """Return a plan of the motion that a bag holds, for a limb file under the bag's loads.

    Raises:
        LimbError, PlanningError: the limb cannot be read, or the motion cannot be planned for it.
    """
    told = run.description
    limb = Limb.from_yaml(file)
    if any(told.gravity):
        limb = dataclasses.replace(limb, gravity=told.gravity)
    limb = limb.carrying(told.payload, told.payload_at or None)
    if told.motion not in NAMES:
        raise PlanningError(
            f"{told.title} holds the drawn path '{told.motion}': give the plan that was played by "
            "--plan FILE (run_experiment.py --learn keeps plans in its folder learned)"
        )
    motion = Motion.named(told.motion, told.amplitude, told.period, told.cycles)
    return plan(limb, motion, model=told.model)


def _check_same(plan_: Plan, run: RunSeries) -> None:
    """Refuse a bag that holds another motion.

    Raises:
        LearningError: its reference is not that of the plan.
    """
    wanted, asked = plan_.tip_reference, run.reference.value
    if wanted.shape != asked.shape:
        raise LearningError(
            f"{run.description.title} holds a motion of {len(asked)} setpoints, the plan has "
            f"{len(wanted)}: give bags of one motion and the limb file it was planned with"
        )
    apart = float(np.linalg.norm(wanted - asked, axis=1).max())
    if apart > _SAME_POINT:
        raise LearningError(
            f"{run.description.title} holds another motion: its reference is up to "
            f"{apart * 100:.1f} cm from the plan's; give bags of one motion and its limb file"
        )
