"""What a drawing would look like if it were played, planned in a process of its own."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.page.worker import Worker
from der_planner.planning import Motion, PathLimits, PlanningError, plan

Array = NDArray[np.float64]

FRAMES = 60
"""Poses of the predicted limb that a preview holds."""
PATH_POINTS = 200


@dataclass(frozen=True)
class Preview:
    """A planned drawing.

    Attributes:
        path: (P, 2) what the tip follows: the nearest path, with the ways there and back [m].
        poses: centrelines (N, 2) [m] of the predicted limb, evenly spaced in time.
        duration: [s].
        largest_pressure: largest |command| [Pa].
        predicted_error: mean distance of the predicted tip from the path [m].
        deviation: in words; empty if the drawing is followed as it is.
        deviation_mean, deviation_largest: of the path from the drawing [m].
        warnings: of the plan, without the deviation.
        problem: why there is no plan; empty if there is one.
    """

    path: Array
    poses: tuple[Array, ...] = ()
    duration: float = 0.0
    largest_pressure: float = 0.0
    predicted_error: float = 0.0
    deviation: str = ""
    deviation_mean: float = 0.0
    deviation_largest: float = 0.0
    warnings: tuple[str, ...] = ()
    problem: str = ""


def preview(limb: Limb, tip: Array, limits: PathLimits, model: str, method: str) -> Preview:
    """Plan a drawing (P, 2) [m] as the planner node would on the topic `path`."""
    nothing = np.empty((0, 2))
    try:
        motion = Motion.from_tip_path(None, tip, limits=limits, nearest=True)
        planned = plan(limb, motion, model, method)
    except PlanningError as error:
        return Preview(nothing, problem=str(error))
    deviation = planned.reference.deviation
    frames = np.linspace(0, len(planned.time) - 1, min(FRAMES, len(planned.time))).astype(int)
    shown = planned.tip_reference[:: max(1, len(planned.time) // PATH_POINTS)]
    said = str(deviation or "")
    return Preview(
        path=shown,
        poses=tuple(planned.curve(int(k)) for k in frames),
        duration=planned.duration,
        largest_pressure=float(np.abs(planned.differential_pressure).max()),
        predicted_error=planned.predicted_error,
        deviation=said,
        deviation_mean=deviation.mean if deviation else 0.0,
        deviation_largest=deviation.largest if deviation else 0.0,
        warnings=tuple(text for text in planned.warnings if text != said),
    )


class Previewer:
    """Plans drawings beside the page, so that the page stays alive.

    Args:
        limits: of the tip, as the planner has them.
    """

    def __init__(self, limits: PathLimits) -> None:
        self._limits = limits
        self._worker = Worker()

    def ask(self, limb: Limb, tip: Array, model: str = "der", method: str = "") -> Future[Preview]:
        """Plan a drawing (P, 2) [m] for a limb; the first starts the process and takes longer."""
        return self._worker.ask(preview, limb, tip, self._limits, model, method)

    def close(self) -> None:
        """End the process, also in the middle of a plan."""
        self._worker.close()
