"""Why a motion cannot be planned: each error names the thing, the place and the remedy."""

from __future__ import annotations

import math


class PlanningError(ValueError):
    """A motion, method or limit does not allow a plan; the message says what to change."""


class UnreachableError(PlanningError):
    """A point of the path lies outside what the limb reaches within its pressure limit.

    Attributes:
        time: of the point in the motion [s].
        point: (x, y) in `limb_base` [m].
        distance: to the nearest reachable point [m].
        required_pressure: largest |differential pressure| the point would need [Pa]; NaN where no
            pressure reaches it.
    """

    def __init__(
        self, time: float, point: tuple[float, float], distance: float, required_pressure: float
    ) -> None:
        needed = (
            "no pressure reaches it"
            if math.isnan(required_pressure)
            else f"it would need {required_pressure / 1000:.1f} kPa"
        )
        super().__init__(
            f"the point ({point[0]:.4f}, {point[1]:.4f}) m at t = {time:.2f} s is out of reach: "
            f"{distance * 1000:.1f} mm from what the limb reaches within its pressure limit; "
            f"{needed}. Move or shrink the path, or lower the amplitude"
        )
        self.time = time
        self.point = point
        self.distance = distance
        self.required_pressure = required_pressure
