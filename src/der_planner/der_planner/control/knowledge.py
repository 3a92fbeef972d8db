"""The estimator's assumptions about noise, and its state."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.model.material import Memory


@dataclass(frozen=True)
class EstimatorSettings:
    """Standard deviations; densities are those of what wanders, per √s.

    Attributes:
        bend_noise: of a measured bend angle whose covariance is not given [rad].
        tip_noise: of a coordinate of a tip whose covariance is not given [m].
        pressure_density: of the effective pressure that is white noise [Pa √s].
        missing_first, missing_density: of d [Pa], [Pa/√s].
        gain_first, gain_density: of g [-], [1/√s].
        tip_first, tip_density: of b [m], [m/√s].
        tip_time: in which b is forgotten [s].
        memory_time: low-pass of δθ before friction and creep [s].
        strange: squared distance per coordinate from where a measurement counts less.
        event_missing, event_rate, event_gain: what an event adds to d [Pa], rates [rad/s], g.
    """

    bend_noise: float = 2e-3
    tip_noise: float = 3e-4
    pressure_density: float = 15.0
    missing_first: float = 600.0
    missing_density: float = 250.0
    gain_first: float = 0.15
    gain_density: float = 0.01
    tip_first: float = 3e-3
    tip_density: float = 4e-4
    tip_time: float = 20.0
    memory_time: float = 0.4
    strange: float = 6.0
    event_missing: float = 1000.0
    event_rate: float = 0.5
    event_gain: float = 0.05


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
        effective_pressure: (M,) of the model, without either [Pa].
        tip_offset: (2,) displacement of the tip that the bend does not explain [m].
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
    effective_pressure: Array
    tip_offset: Array
    deviation: Array
    tip_covariance: Array
    age: float


@dataclass(frozen=True)
class Knowledge:
    """The filter at a boundary of fine steps.

    Attributes:
        mean: (4M + 2,) x.
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
        return np.split(self.mean, np.arange(1, 5) * len(self.taken))
