"""Learned plans of a limb as a start for a new motion: the same one, a little slower or larger.

What a learned plan knows beyond its model is the disturbance d(t) = tip expected − model(commands).
A motion of another period or amplitude meets nearly the same one at the same phase, so that d is
stretched to the new duration, scaled by the amplitude, and planned against.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from der_planner.control.learning import PULL
from der_planner.methods import LEARNED
from der_planner.planning.correction import Correction
from der_planner.planning.errors import PlanningError
from der_planner.planning.plan_file import SUFFIX, Plan, difference, read_plan

NEAR = math.log(1.35)
"""Largest logarithm of the ratio of two periods and amplitudes that are near each other."""


def nearest(folder: str | Path, wanted: Plan) -> tuple[Path, Plan] | None:
    """Return the learned plan that is nearest to a fresh one, and its file; None: none is near.

    It is of the same limb under the same loads, model, motion and number of cycles, with period and
    amplitude within a third. Of several the nearest, then the newest is taken; files that hold no
    plan are passed over.

    Args:
        folder: of plan files.
        wanted: the motion planned without what was learned.
    """
    found: list[tuple[float, float, Path, Plan]] = []
    for file in sorted(Path(folder).glob(f"*{SUFFIX}")):
        try:
            kept = read_plan(file)
        except PlanningError:
            continue
        far = _distance(kept, wanted)
        if kept.method == LEARNED and far <= NEAR:
            found.append((round(far, 6), -file.stat().st_mtime, file, kept))
    if not found:
        return None
    _, _, file, kept = min(found, key=lambda entry: entry[:2])
    return file, kept


def _distance(one: Plan, other: Plan) -> float:
    """Return how far apart two plans are, infinite where nothing can be carried over."""
    same = all(getattr(one, key) == getattr(other, key) for key in ("motion", "model", "cycles"))
    numbers = (one.period, other.period, one.amplitude, other.amplitude)
    if not same or min(numbers) <= 0 or one.reference.start is not None:
        return math.inf
    if difference(one.limb.to_mapping(), other.limb.to_mapping()):
        return math.inf
    slower, larger = one.period / other.period, one.amplitude / other.amplitude
    return math.hypot(math.log(slower), math.log(larger))


def carried_over(fresh: Plan, learned: Plan) -> Plan:
    """Return the plan of a motion that begins from what a near one has learned.

    Args:
        fresh: the motion planned without it.
        learned: see `nearest`.

    Raises:
        PlanningError: a model cannot be rolled forward, or the optimiser found no plan.
    """
    model = Correction(learned).expected(learned.differential_pressure).tip
    shown = (learned.tip_predicted - model) * (fresh.amplitude / learned.amplitude)
    phase = fresh.time * (learned.duration / fresh.duration)
    expected = np.column_stack([np.interp(phase, learned.time, axis) for axis in shown.T])
    correction = Correction(fresh)
    return correction.plan(
        fresh.differential_pressure, expected, PULL * correction.tip_per_pressure
    )
