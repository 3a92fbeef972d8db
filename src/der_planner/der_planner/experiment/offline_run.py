"""One trial in this process: plan, play on the simulated pneumatics and limb, keep the arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.bags.run import method_name
from der_planner.control import Feedback, lockstep
from der_planner.control.lockstep import Played
from der_planner.experiment.errors import GraphError
from der_planner.experiment.options import Options, Trial
from der_planner.experiment.progress import Progress
from der_planner.identification.offline import CALIBRATION_RUN
from der_planner.limb import Limb
from der_planner.planning import Plan, PlanningError, plan
from der_planner.planning.plan_file import read_plan
from der_planner.results import Description, RunSeries
from der_planner.twin.offline import OfflineTwin

_AT_REST = 1.0
"""The twin is vented for so long before the first setpoint [s]."""


def play_offline(
    trial: Trial,
    options: Options,
    robot: Limb,
    metadata: dict[str, Any],
    progress: Progress,
    learned: Path | None = None,
) -> dict[str, Any]:
    """Plan, play and keep one trial; the error is against the twin's true tip, not an image's.

    Args:
        trial: what to play.
        options: of the experiment.
        robot: to plan with, under its loads; the twin is mounted as it is and carries its masses.
        metadata: kept with the arrays.
        progress: shows the plan's warnings.
        learned: file of a learned plan, which is played in place of a new one.

    Raises:
        GraphError: the motion cannot be planned; with the planner's reason.
    """
    try:
        if learned is not None:
            planned = read_plan(learned)
        else:
            motion = options.motion(trial.motion)
            planned = plan(robot, motion, model=trial.model, method=trial.method)
    except PlanningError as error:
        raise GraphError(f"the planner refused: {error}") from error
    for warning in planned.warnings:
        progress.say(f"  warning: {warning}")
    played, about_feedback = _play(planned, trial, robot)
    payload, place = robot.payload
    path = options.out / "runs" / f"{trial.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        metadata=json.dumps(
            {
                **metadata,
                "gravity_m_s2": robot.gravity,
                "payload_kg": payload,
                "payload_at_m": place,
                **({"feedback": about_feedback} if about_feedback else {}),
            }
        ),
        time=planned.time,
        tip_reference=planned.tip_reference,
        tip_predicted=planned.tip_predicted,
        differential_pressure=played.commanded,
        planned_pressure=planned.differential_pressure,
        measured_differential=played.differential_pressure,
        tip=played.tip,
        tip_estimated=played.estimated_tip,
        missing_pressure=played.missing_pressure,
    )
    return {
        "arrays": str(path.relative_to(options.out)),
        "solve_time_s": planned.solve_time,
        "predicted_error_m": planned.predicted_error,
    }


def _run_of_twin(trial: Trial) -> int:
    """Return which wander of the rest angles the twin has: one of its own for every run."""
    return 0 if trial.run == 1 else CALIBRATION_RUN + trial.run - 1


def _play(planned: Plan, trial: Trial, robot: Limb) -> tuple[Played, dict[str, Any]]:
    """Play a plan on the twin; return also what feedback did, in numbers."""
    plant = OfflineTwin(
        trial.seed,
        run=_run_of_twin(trial),
        segment_count=robot.segment_count,
        gravity=robot.gravity,
        masses=robot.masses,
    )
    plant.rest(_AT_REST)
    feedback = Feedback(planned) if trial.feedback else None
    played = lockstep.play(planned, plant, feedback, lockstep.Sensors(seed=trial.seed))
    if feedback is None:
        return played, {}
    size = np.linalg.norm(played.estimated_tip - played.tip, axis=1)
    return played, {
        "correction_rms_pa": np.sqrt(np.mean(played.correction**2, axis=0)).tolist(),
        "correction_max_pa": np.abs(played.correction).max(axis=0).tolist(),
        "estimate_rms_m": float(np.sqrt(np.mean(size**2))),
        "warnings": [f"{w.time:.2f} s: {w.name}, {w.message}" for w in feedback.warnings],
    }


def load_arrays(path: Path) -> RunSeries:
    """Read a run that `play_offline` kept."""
    with np.load(path) as kept:
        about = json.loads(str(kept["metadata"]))
        return RunSeries.from_arrays(
            Description(
                motion=about["motion"],
                model=about["model"],
                method=method_name(about["method"], about.get("learned_from")),
                trial=about["trial"],
                seed=about["seed"],
                amplitude=about["amplitude_rad"],
                period=about["period_s"],
                cycles=about["cycles"],
                limb=about["limb"],
                bag=str(path),
                gravity=tuple(about.get("gravity_m_s2", (0.0, 0.0, 0.0))),
                payload=about.get("payload_kg", 0.0),
                payload_at=about.get("payload_at_m", 0.0),
                extra=about,
            ),
            time=kept["time"],
            tip=kept["tip"],
            reference_time=kept["time"],
            tip_reference=kept["tip_reference"],
            tip_predicted=kept["tip_predicted"],
            pressure_time=kept["time"],
            commanded=kept["differential_pressure"],
            measured=kept["measured_differential"],
            setpoints=kept["differential_pressure"],
        )
