"""The plan of a recorded run, made again for a limb file."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from der_planner.control import LearningError
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, PlanningError, plan
from der_planner.planning.motions import NAMES
from der_planner.results import RunSeries

_SAME_POINT = 2e-3
"""References whose points lie further apart than this [m] are not of one motion."""


def plan_of(run: RunSeries, file: Path) -> Plan:
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


def check_same(plan_: Plan, run: RunSeries) -> None:
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
