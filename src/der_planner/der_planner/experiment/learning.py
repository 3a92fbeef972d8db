"""Learning within an experiment: from the recorded runs of a trial to the plan of the next one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from der_planner.bags.run import RunSeries
from der_planner.control import Learner, LearningError
from der_planner.control.library import carried_over, nearest
from der_planner.experiment.errors import GraphError
from der_planner.experiment.options import Options, Trial
from der_planner.experiment.progress import Progress
from der_planner.limb import Limb
from der_planner.planning import Plan, PlanningError, plan
from der_planner.planning.plan_file import read_plan, write_plan

FOLDER = "learned"
"""Of an experiment's learned plans."""


def add_run(learner: Learner, run: RunSeries) -> None:
    """Add a recorded run to a learner.

    Raises:
        GraphError: the run's plan has another grid of setpoints, or its arrays do not fit.
    """
    given = run.tip_covariance.value
    whole = len(given) == len(run.tip) and bool(np.isfinite(given).any())
    covariance = given.reshape(-1, 2, 2) if whole else None
    held = run.measured
    told = (held.time, held.value) if len(held) else None
    try:
        learner.add(
            run.tip.time,
            run.tip.value,
            covariance,
            commands=run.setpoints.value,
            chambers=told,
        )
    except LearningError as error:
        raise GraphError(f"cannot learn from {run.description.title}: {error}") from error


def about(learner: Learner, **more: Any) -> dict[str, Any]:
    """Return a summary of the runs so far, to be kept with a plan.

    Args:
        learner: with its history.
        more: what else is to be kept.
    """
    return {
        **more,
        "mean_error_m": [run.mean_error for run in learner.history],
        "accepted": [run.accepted for run in learner.history],
        "reasons": [run.reason for run in learner.history],
        "repeatability_m": learner.repeatability,
        "stopped": learner.stopped,
    }


def _fresh(trial: Trial, options: Options, robot: Limb) -> Plan:
    motion = options.motion(trial.motion)
    return plan(robot, motion, model=trial.model, method=trial.method)


def _file_of_first(trial: Trial, options: Options) -> Path:
    """Return where the plan of a trial's first run is, if it begins from a library."""
    return options.out / FOLDER / f"{trial.name}.yaml"


def begin_from_library(
    trial: Trial, options: Options, robot: Limb, progress: Progress
) -> Path | None:
    """Write the plan of a first run that begins from a near learned one, and return its file.

    None: no learned plan in the library is near.

    Raises:
        GraphError: the motion cannot be planned.
    """
    if options.library is None:
        return None
    try:
        fresh = _fresh(trial, options, robot)
        found = nearest(options.library, fresh)
        if found is None:
            progress.say(f"  no learned plan in {options.library} is near this motion")
            return None
        file, learned = found
        begun = carried_over(fresh, learned)
    except PlanningError as error:
        raise GraphError(f"{trial.name} cannot be planned: {error}") from error
    path = _file_of_first(trial, options)
    write_plan(begun, path, {"begun_from": str(file)})
    progress.say(f"  begins from what was learned in {file}")
    return path


class TrialLearning:
    """The learner of one trial's motion.

    Args:
        trial: the first run.
        options: of the experiment.
        robot: limb that the trial was planned with, under its loads.
        progress: shows what was learned.

    Raises:
        GraphError: the motion cannot be planned, or its model cannot be learned.
    """

    def __init__(self, trial: Trial, options: Options, robot: Limb, progress: Progress) -> None:
        self._trial, self._options, self._progress = trial, options, progress
        begun = _file_of_first(trial, options)
        try:
            first = read_plan(begun) if begun.exists() else _fresh(trial, options, robot)
            self._learner = Learner(first)
        except (PlanningError, LearningError) as error:
            raise GraphError(f"{trial.name} cannot be learned: {error}") from error

    @property
    def stopped(self) -> str:
        """Why nothing more is learned; empty while it goes on."""
        return self._learner.stopped

    def take(self, run: RunSeries) -> None:
        """Learn from a finished run, and print what came of it.

        Raises:
            GraphError: the run is not one of this motion.
        """
        add_run(self._learner, run)
        last = self._learner.history[-1]
        self._progress.say(
            f"  run {last.number}: mean error {last.mean_error * 100:.3f} cm; {last.reason}"
        )

    def next(self, name: str) -> Path:
        """Write the plan to play next under a name, and return its file.

        Raises:
            GraphError: the optimiser found no plan.
        """
        try:
            following: Plan = self._learner.next()
        except PlanningError as error:
            raise GraphError(f"{name} cannot be planned: {error}") from error
        path = self._options.out / FOLDER / f"{name}.yaml"
        write_plan(
            following,
            path,
            about=about(self._learner, seed=self._trial.seed, trial=self._trial.number),
        )
        return path

    def conclude(self) -> None:
        """Keep the plan to go on with, and say where it is.

        Raises:
            GraphError: the optimiser found no plan.
        """
        trial = self._trial
        path = self.next(f"{trial.motion}_{trial.model}_trial{trial.number}")
        self._progress.say(
            f"  {self.stopped or 'learning can go on from here'}; the plan to go on with: {path}"
        )
