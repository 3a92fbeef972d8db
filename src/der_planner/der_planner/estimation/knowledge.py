"""What the estimator tells of the limb, and its own state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.model.material import Memory


@dataclass(frozen=True)
class Estimate:
    """What is known of the limb at an instant.

    Attributes:
        time: [s] of the plan.
        bend_angle, bend_rate: (M,) [rad], [rad/s].
        tip: (2,) [m].
        missing_pressure: (M,) effective pressure that the model lacks, its gain error not counted
            [Pa].
        gain_error: (M,) relative error of the model's effective pressure.
        tip_offset: (2,) displacement of the tip that the bend does not explain [m].
        stiffness_ratio: how many times stiffer than its model the limb is, as its swings tell.
        deviation: (4M + 2,) standard deviations of bend_angle, bend_rate, missing_pressure,
            gain_error and tip_offset, in this order.
        tip_covariance: (2, 2) [m²].
        age: time since the newest measurement that it knows [s].
    """

    time: float
    bend_angle: Array
    bend_rate: Array
    tip: Array
    missing_pressure: Array
    gain_error: Array
    tip_offset: Array
    stiffness_ratio: float
    deviation: Array
    tip_covariance: Array
    age: float


@dataclass(frozen=True)
class Knowledge:
    """The filter at a boundary of fine steps.

    Attributes:
        mean: (4M + 3,) x.
        covariance: of x.
        slow: (M,) slow part of δθ [rad].
        memory: of friction and creep.
        taken: (M,) pressure that friction and creep take [Pa].
        effective: (M,) effective pressure of the model [Pa].
        strange: squared distances of the last measurements per coordinate, smoothed; 1 is expected.
        row: measurements in a row that were not expected.
    """

    mean: Array
    covariance: Array
    slow: Array
    memory: Memory
    taken: Array
    effective: Array
    strange: float = 1.0
    row: int = 0

    @property
    def parts(self) -> list[Array]:
        """δθ [rad], δθ̇ [rad/s], d [Pa] and g [-], (M,) each, and b (2,) [m]."""
        return np.split(self.mean[:-1], np.arange(1, 5) * len(self.taken))

    @property
    def stiffness_ratio(self) -> float:
        """How many times stiffer than its model the limb is, gains and all, as its swings tell."""
        return float(np.exp(self.mean[-1]))
