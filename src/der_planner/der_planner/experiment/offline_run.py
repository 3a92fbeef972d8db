"""One trial in this process: plan, play on the simulated pneumatics and limb, keep the arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.experiment.errors import GraphError
from der_planner.experiment.options import Options, Trial
from der_planner.limb import Limb
from der_planner.planning import PlanningError, plan
from der_planner.runs.evaluation import Description, RunSeries
from der_planner.twin.offline import play


def play_offline(
    trial: Trial, options: Options, robot: Limb, metadata: dict[str, Any]
) -> dict[str, Any]:
    """Plan, play and keep one trial; the error is against the twin's true tip, not an image's.

    Args:
        trial: what to play.
        options: of the experiment.
        robot: to plan with, under its loads; the twin is mounted as it is and carries its masses.
        metadata: kept with the arrays.

    Raises:
        GraphError: the motion cannot be planned; with the planner's reason.
    """
    try:
        motion = options.motion(trial.motion)
        planned = plan(robot, motion, model=trial.model, method=trial.method)
    except PlanningError as error:
        raise GraphError(f"the planner refused: {error}") from error
    played = play(
        planned.time,
        planned.differential_pressure,
        seed=trial.seed,
        gravity=robot.gravity,
        masses=robot.masses,
    )
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
            }
        ),
        time=planned.time,
        tip_reference=planned.tip_reference,
        tip_predicted=planned.tip_predicted,
        differential_pressure=planned.differential_pressure,
        measured_differential=played.measured_differential,
        tip=played.tip,
    )
    return {
        "arrays": str(path.relative_to(options.out)),
        "solve_time_s": planned.solve_time,
        "predicted_error_m": planned.predicted_error,
    }


def load_arrays(path: Path) -> RunSeries:
    """Read a run that `play_offline` kept."""
    with np.load(path) as kept:
        about = json.loads(str(kept["metadata"]))
        return RunSeries.from_arrays(
            Description(
                motion=about["motion"],
                model=about["model"],
                method=about["method"],
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
        )
