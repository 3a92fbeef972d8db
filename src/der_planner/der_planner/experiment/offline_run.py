"""One run in this process: plan, play on the simulated pneumatics and limb, keep the arrays."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from der_planner.arrays import rms_distance
from der_planner.bags.run import Description, PressureArrays, RunSeries, method_name
from der_planner.bags.series import described
from der_planner.control import Feedback, lockstep
from der_planner.control.lockstep import Played
from der_planner.experiment.console import Progress
from der_planner.experiment.options import TrialRun
from der_planner.identification.excitation import CALIBRATION_RUN
from der_planner.planning import Plan
from der_planner.planning.plan_file import read_plan
from der_planner.twin.offline import OfflineTwin

_AT_REST = 1.0
"""The twin is vented this long [s] before the first setpoint."""
_NAMED = ("motion", "model", "trial", "seed", "cycles", "limb")
"""What a kept run and its description name alike."""


def play_offline(run: TrialRun, progress: Progress) -> dict[str, Any]:
    """Plan, play and keep one run; the error is against the twin's true tip, not an image's.

    Returns:
        What is kept of it beside its arrays.

    Raises:
        PlanningError: the motion cannot be planned.
    """
    planned = read_plan(run.learned) if run.learned is not None else run.plan()
    for warning in planned.warnings:
        progress.say(f"  warning: {warning}")
    played, feedback = _play(planned, run)
    payload, place = run.limb.payload
    about = {
        **run.metadata,
        "gravity_m_s2": run.limb.gravity,
        "payload_kg": payload,
        "payload_at_m": place,
        **({"feedback": feedback} if feedback else {}),
    }
    path = run.options.out / "runs" / f"{run.trial.name}.npz"
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        metadata=json.dumps(about),
        time=planned.time,
        tip_reference=planned.tip_reference,
        tip_predicted=planned.tip_predicted,
        differential_pressure=played.commanded,
        measured_differential=played.differential_pressure,
        tip=played.tip,
    )
    return {"arrays": str(path.relative_to(run.options.out))}


def _play(planned: Plan, run: TrialRun) -> tuple[Played, dict[str, Any]]:
    """Play a plan on the twin; return also what feedback did, in numbers."""
    trial, limb = run.trial, run.limb
    plant = OfflineTwin(
        trial.seed,
        # The rest angles wander in every run in a way of their own.
        run=0 if trial.run == 1 else CALIBRATION_RUN + trial.run - 1,
        segment_count=limb.segment_count,
        gravity=limb.gravity,
        masses=limb.masses,
    )
    if (obstacles := run.options.in_the_way) is not None:
        plant.twin.put_pegs(obstacles.circles)
    plant.rest(_AT_REST)
    reaction, limit = run.options.reaction, run.options.force_limit or None
    feedback = Feedback(planned, reaction, limit) if trial.feedback else None
    played = lockstep.play(planned, plant, feedback, lockstep.Sensors(seed=trial.seed))
    if feedback is None:
        return played, {}
    return played, {
        **described(played.correction, np.empty(0)),
        "estimate_rms_m": rms_distance(played.estimated_tip - played.tip),
        "warnings": [f"{w.time:.2f} s: {w.name}, {w.message}" for w in feedback.warnings],
    }


def load_arrays(path: Path) -> RunSeries:
    """Read a run that `play_offline` kept."""
    with np.load(path) as kept:
        about = json.loads(str(kept["metadata"]))
        return RunSeries.from_arrays(
            Description(
                **{name: about[name] for name in _NAMED},
                method=method_name(about["method"], about.get("learned_from")),
                amplitude=about["amplitude_rad"],
                period=about["period_s"],
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
            pressures=PressureArrays(
                kept["time"], kept["differential_pressure"], kept["measured_differential"]
            ),
            setpoints=kept["differential_pressure"],
        )
