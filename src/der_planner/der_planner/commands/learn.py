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
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from der_planner.control import Learner, LearningError
from der_planner.estimation.hindsight import Filmed, touches
from der_planner.experiment.console import check_file, command
from der_planner.limb import Limb, LimbError, Load
from der_planner.planning import Motion, Obstacles, Plan, PlanningError, plan
from der_planner.planning.motions import NAMES
from der_planner.planning.plan_file import read_plan, write_plan
from der_planner.results import BagError, EvaluationError, RunSeries, load_run
from der_planner.results.evaluation import DRAWN

FAILURES = (BagError, EvaluationError, LearningError, LimbError, PlanningError, OSError)
"""What a bag, a limb file, a plan or a disk may be lacking."""
Verdict = TypeVar("Verdict")
_SAME_POINT = 2e-3
"""References whose points lie further apart than this [m] are not of one motion."""


@command(*FAILURES, code=2)
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line."""
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bags, oldest first")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="the next plan")
    add_plan_options(parser)
    parser.add_argument("--namespace", default="", help="of the limb, where a bag holds several")
    given = parser.parse_args()
    check_file(given.out)
    runs = [load_run(bag, namespace=given.namespace) for bag in given.bags]
    first = plan_of(runs[0], given)
    learner = Learner(first)
    for run in runs:
        check_same(first, run)
        add_run(learner, run)
        last = learner.history[-1]
        said = f"mean error {last.mean_error * 100:.3f} cm; {last.reason}"
        print(f"{run.description.title}: {said}")
        judged = last.accepted and len(run.measured.known) > 0
        for touch, end in in_hindsight(touches, first, run) if judged else ():
            print(
                f"warning: something seems to touch the limb in it from {touch.since:.1f} to "
                f"{end:.1f} s ({touch.said}): learn from runs that nothing touches",
                file=sys.stderr,
            )
    if not any(run.accepted for run in learner.history):
        print("error: no run was used, so nothing was learned", file=sys.stderr)
        return 1
    following = learner.next()
    write_plan(following, given.out, learning_summary(learner))
    print(
        f"{given.out}: expected mean error {following.predicted_error * 100:.3f} cm"
        + (f"; stopped: {learner.stopped}" if learner.stopped else "")
    )
    return 0


def add_run(learner: Learner, run: RunSeries) -> None:
    """Add a recorded run to a learner.

    Raises:
        LearningError: the run's plan has another grid of setpoints, or its arrays do not fit.
    """
    covariance, measured = run.tip_covariance.value, run.measured
    known = len(covariance) == len(run.tip) and bool(np.isfinite(covariance).any())
    try:
        learner.add(
            run.tip.time,
            run.tip.value,
            covariance.reshape(-1, 2, 2) if known else None,
            commands=run.setpoints.value,
            chambers=(measured.time, measured.value) if len(measured) else None,
        )
    except LearningError as error:
        raise LearningError(f"cannot learn from {run.description.title}: {error}") from error


def learning_summary(learner: Learner) -> dict[str, Any]:
    """Return what is kept with a learned plan of the runs that it was learned from."""
    return {
        "mean_error_m": [run.mean_error for run in learner.history],
        "accepted": [run.accepted for run in learner.history],
        "reasons": [run.reason for run in learner.history],
        "repeatability_m": learner.repeatability,
        "stopped": learner.stopped,
    }


# The plan of a recorded run ----------------------------------------------------------------------


def add_plan_options(parser: argparse.ArgumentParser, needed: bool = True) -> None:
    """Add --limb or --plan, of which one may be needed, --path and --obstacles."""
    base = parser.add_mutually_exclusive_group(required=needed)
    base.add_argument("--limb", type=Path, metavar="FILE", help="limb file of the plan in the bag")
    base.add_argument("--plan", type=Path, metavar="FILE", help="learned plan that was played")
    parser.add_argument(
        "--path", type=Path, metavar="FILE.csv", help="path that was drawn in the bag, if any"
    )
    parser.add_argument(
        "--obstacles", type=Path, metavar="FILE", help="obstacles of the plan in the bag, if any"
    )


def plan_of(run: RunSeries, given: argparse.Namespace) -> Plan:
    """Return the plan of --plan, or the one of a bag's motion for --limb under the bag's loads.

    Raises:
        LimbError, PlanningError: a file cannot be read, or the motion cannot be planned.
    """
    if given.plan:
        return read_plan(given.plan)
    told = run.description
    limb = dataclasses.replace(Limb.from_yaml(given.limb), gravity=told.gravity)
    limb = limb.loaded(Load(told.payload, told.payload_at))
    if given.path:
        motion = Motion.from_csv(given.path, nearest=DRAWN in told.extra)
    elif told.motion in NAMES:
        motion = Motion.named(told.motion, told.amplitude, told.period, told.cycles)
    else:
        raise PlanningError(
            f"{told.title} holds the drawn path '{told.motion}': give its file by --path FILE.csv, "
            "or the plan that was played by --plan FILE"
        )
    in_the_way = Obstacles.from_yaml(given.obstacles) if given.obstacles else None
    try:
        return plan(limb, motion, model=told.model, obstacles=in_the_way)
    except PlanningError as error:
        raise PlanningError(
            f"{error}. It was played: give the limb file that {told.title} was planned with, "
            f"{told.limb or 'the default one'}"
        ) from error


def in_hindsight(
    judge: Callable[[Plan, Filmed], Verdict], planned: Plan, run: RunSeries
) -> Verdict:
    """Judge a recorded run by what camera and board showed of it.

    Args:
        judge: takes the plan as it was played, and what was filmed of it.
        planned: the run's motion, for the limb that is to be judged.
        run: recorded.

    Raises:
        LearningError: the run is of another motion.
        EvaluationError: it holds no pictures or no measured pressures.
    """
    check_same(planned, run)
    played = dataclasses.replace(planned, differential_pressure=run.setpoints.value)
    filmed = Filmed(
        run.measured.time, run.measured.value, run.tip.time, run.bend_angle.value, run.tip.value
    )
    try:
        return judge(played, filmed)
    except ValueError as error:
        raise EvaluationError(f"{run.description.title}: {error}") from error


def check_same(planned: Plan, run: RunSeries) -> None:
    """Refuse a bag that holds another motion.

    Raises:
        LearningError: its reference is not that of the plan.
    """
    wanted, asked = planned.tip_reference, run.reference.value
    apart = f"{len(asked)} and {len(wanted)} setpoints"
    if wanted.shape == asked.shape:
        farthest = float(np.linalg.norm(wanted - asked, axis=1).max())
        if farthest <= _SAME_POINT:
            return
        apart = f"references up to {farthest * 100:.1f} cm apart"
    raise LearningError(
        f"{run.description.title} holds another motion than the plan ({apart}): give bags of one "
        "motion, and the limb file and the --obstacles that it was planned with"
    )
