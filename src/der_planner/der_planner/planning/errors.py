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
        self,
        time: float,
        point: tuple[float, float],
        distance: float,
        required_pressure: float,
        carried: float = 0.0,
    ) -> None:
        needed = (
            "no pressure reaches it"
            if math.isnan(required_pressure)
            else f"it would need {required_pressure / 1000:.1f} kPa"
        )
        lighter = f"It carries {carried * 1000:.1f} g: carry less, move" if carried else "Move"
        super().__init__(
            f"the point ({point[0]:.4f}, {point[1]:.4f}) m at t = {time:.2f} s is out of reach: "
            f"{distance * 1000:.1f} mm from what the limb reaches within its pressure limit; "
            f"{needed}. {lighter} or shrink the path, or lower the amplitude"
        )
        self.time = time
        self.point = point
        self.distance = distance
        self.required_pressure = required_pressure


class BucklingError(PlanningError):
    """The limb buckles, snaps through or has more than one rest under its loads."""


class OverloadError(PlanningError):
    """Holding the limb along a motion takes more pressure than it may have.

    Attributes:
        time: when most is needed [s].
        point: (x, y) of the tip then, in `limb_base` [m].
        segment: which needs most.
        required_pressure: |differential pressure| that it needs there at rest [Pa].
        pressure_limit: largest that is allowed [Pa].
        possible_mass: most that the limb could carry along this motion [kg]; None: it carries
            nothing, or cannot be held without it either.
    """

    def __init__(
        self,
        time: float,
        point: tuple[float, float],
        segment: int,
        required_pressure: float,
        pressure_limit: float,
        carried: float = 0.0,
        possible_mass: float | None = None,
    ) -> None:
        remedy = "Shrink or move the motion, or mount the limb otherwise"
        if carried and possible_mass is None:
            weight = f"{carried * 1000:.1f} g"
            remedy = f"Even without the {weight} that it carries it is too much. {remedy}"
        elif carried and possible_mass is not None:
            remedy = (
                f"It carries {carried * 1000:.1f} g: {possible_mass * 1000:.1f} g are possible "
                "along this motion, or more along a smaller one"
            )
        super().__init__(
            f"segment {segment} would need {required_pressure / 1000:.1f} kPa to hold the limb at "
            f"t = {time:.2f} s, where the tip is to be at ({point[0]:.4f}, {point[1]:.4f}) m: "
            f"{pressure_limit / 1000:.1f} kPa are allowed. {remedy}"
        )
        self.time = time
        self.point = point
        self.segment = segment
        self.required_pressure = required_pressure
        self.pressure_limit = pressure_limit
        self.possible_mass = possible_mass
