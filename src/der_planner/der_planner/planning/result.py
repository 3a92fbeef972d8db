"""What a planner hands over: timed pressures, and what the model expects of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.model.bending import Kinematics
from der_planner.planning.motions import Reference

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """A planned motion of K setpoints, 50 ms apart.

    Attributes:
        time: (K,) instants of the setpoints since the first [s].
        differential_pressure: (K, M) commands, each held until the next [Pa].
        reference: r̄ and q̄ as functions of time.
        tip_predicted: (K, 2) tip of the model under these commands, with the chambers' lag [m].
        bend_angles: (K, M) of the model's reference configuration [rad].
        motion, model, method: names, as they were asked for.
        amplitude, period, cycles: of the motion; 0, 0 and 1 for a path.
        limb: the robot it was made for.
        kinematics: of the model, for drawing.
        solve_time: wall time of the planning [s].
        warnings: sentences: limits that cut the wanted pressures, ranges that were left.
        details: numbers of the method: iterations, cost, Newton steps.
        chambers_beyond: (K, M) by how much the chambers held more than their model in the last run
            that a learned plan is from, mean of each period [Pa]; None: nobody told.
    """

    time: Array
    differential_pressure: Array
    reference: Reference
    tip_predicted: Array
    bend_angles: Array
    motion: str
    model: str
    method: str
    amplitude: float
    period: float
    cycles: int
    limb: Limb
    kinematics: Kinematics
    solve_time: float
    warnings: tuple[str, ...] = ()
    details: dict[str, float] = field(default_factory=dict)
    chambers_beyond: Array | None = None

    @property
    def tip_reference(self) -> Array:
        """(K, 2) r̄ at the setpoints [m]."""
        return self.reference.tip

    def curve(self, index: int) -> Array:
        """Return the centreline (P, 2) [m] of the reference configuration at a setpoint."""
        return self.kinematics.curve(self.bend_angles[index])

    @property
    def error(self) -> Array:
        """(K,) distance of the predicted from the reference tip [m]."""
        distance: Array = np.linalg.norm(self.tip_predicted - self.tip_reference, axis=1)
        return distance

    @property
    def predicted_error(self) -> float:
        """Mean distance of the predicted from the reference tip [m]."""
        return float(self.error.mean())

    @property
    def largest_error(self) -> float:
        """Largest distance of the predicted from the reference tip [m]."""
        return float(self.error.max())

    @property
    def duration(self) -> float:
        """Instant of the last setpoint [s]."""
        return float(self.time[-1])

    @property
    def pressure_margin(self) -> float:
        """What is left to the pressure limit at the largest command [Pa]."""
        largest = float(np.abs(self.differential_pressure).max())
        return self.limb.pneumatics.pressure_limit - largest

    @property
    def slew_margin(self) -> float:
        """What is left to the slew limit at the fastest change, the first from rest [Pa/s]."""
        steps = np.diff(self.differential_pressure, axis=0)
        fastest = float(np.abs(steps).max(initial=0.0)) / float(self.time[1] - self.time[0])
        return self.limb.pneumatics.slew_limit - fastest
