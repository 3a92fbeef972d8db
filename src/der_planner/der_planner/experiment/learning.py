"""Learning within an experiment: from the recorded runs of a trial to the plan of the next one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from der_planner.bags.run import RunSeries
from der_planner.control import Learner, LearningError
from der_planner.experiment.console import Progress
from der_planner.experiment.options import TrialRun
from der_planner.experiment.processes import GraphError
from der_planner.planning import PlanningError
from der_planner.planning.correction import carried_over, nearest
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
    measured = run.measured
    try:
        learner.add(
            run.tip.time,
            run.tip.value,
            given.reshape(-1, 2, 2) if whole else None,
            commands=run.setpoints.value,
            chambers=(measured.time, measured.value) if len(measured) else None,
        )
    except LearningError as error:
        raise GraphError(f"cannot learn from {run.description.title}: {error}") from error


def about(learner: Learner, **more: Any) -> dict[str, Any]:
    """Return a summary of the runs so far, and what ``more`` is to be kept with a plan."""
    return {
        **more,
        "mean_error_m": [run.mean_error for run in learner.history],
        "accepted": [run.accepted for run in learner.history],
        "reasons": [run.reason for run in learner.history],
        "repeatability_m": learner.repeatability,
        "stopped": learner.stopped,
    }


def _file(run: TrialRun, name: str) -> Path:
    return run.options.out / FOLDER / f"{name}.yaml"


def begin_from_library(run: TrialRun, progress: Progress) -> Path | None:
    """Write the plan of a first run that begins from a near learned one, and return its file.

    None: no learned plan in the library is near.

    Raises:
        GraphError: the motion cannot be planned.
    """
    library = run.options.library
    if library is None:
        return None
    try:
        fresh = run.plan()
        found = nearest(library, fresh)
        if found is None:
            progress.say(f"  no learned plan in {library} is near this motion")
            return None
        file, learned = found
        begun = carried_over(fresh, learned)
    except PlanningError as error:
        raise GraphError(f"{run.trial.name} cannot be planned: {error}") from error
    path = _file(run, run.trial.name)
    write_plan(begun, path, {"begun_from": str(file)})
    progress.say(f"  begins from what was learned in {file}")
    return path


class TrialLearning:
    """The learner of one trial's motion.

    Args:
        run: the first one of the trial.
        progress: shows what was learned.

    Raises:
        GraphError: the motion cannot be planned, or its model cannot be learned.
    """

    def __init__(self, run: TrialRun, progress: Progress) -> None:
        self._run, self._progress = run, progress
        begun = _file(run, run.trial.name)
        try:
            self._learner = Learner(read_plan(begun) if begun.exists() else run.plan())
        except (PlanningError, LearningError) as error:
            raise GraphError(f"{run.trial.name} cannot be learned: {error}") from error

    @property
    def stopped(self) -> str:
        """Why nothing more is learned; empty while it goes on."""
        return self._learner.stopped

    def add(self, run: RunSeries) -> None:
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
        trial, path = self._run.trial, _file(self._run, name)
        try:
            following = self._learner.next()
        except PlanningError as error:
            raise GraphError(f"{name} cannot be planned: {error}") from error
        write_plan(following, path, about(self._learner, seed=trial.seed, trial=trial.number))
        return path

    def conclude(self) -> None:
        """Keep the plan to go on with, and say where it is.

        Raises:
            GraphError: the optimiser found no plan.
        """
        trial = self._run.trial
        path = self.next(f"{trial.motion}_{trial.model}_trial{trial.number}")
        self._progress.say(
            f"  {self.stopped or 'learning can go on from here'}; the plan to go on with: {path}"
        )
