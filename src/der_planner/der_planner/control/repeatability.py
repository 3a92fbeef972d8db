"""What repeats from run to run, told from what does not.

Two runs i, j of a limb show disturbances that differ by what does not repeat (variance N of a run)
and by what the model's answer to a change of commands lacks, a share ε of the movement Δ that the
change makes:

    E |d_i − d_j|² = 2 N + ε² Δ_ij²        a coordinate, mean over the motion

Runs of one plan have Δ = 0 and show N alone. N and ε are those of the largest likelihood over all
pairs, on a grid, with a prior for ε. A disturbance wanders slowly, so that the mean square of a
pair counts as that of a few independent numbers only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DEGREES = 4.0
"""Independent numbers in the difference of two runs."""
_PRIOR_SHARE = 0.1
"""ε that is expected before runs were compared: hysteresis makes small changes stiffer."""
_PRIOR_FACTOR = 3.0
"""One standard deviation of ln ε is the logarithm of this."""
_SHARES = np.geomspace(0.003, 3.0, 61)
_DEVIATIONS = np.geomspace(3e-6, 3e-2, 81)


@dataclass(frozen=True)
class Pair:
    """Two runs compared.

    Attributes:
        difference: mean square of the difference of their disturbances, a coordinate [m²].
        noise: share of it that the camera's noise explains [m²].
        movement: Δ², a coordinate [m²].
    """

    difference: float
    noise: float
    movement: float


@dataclass(frozen=True)
class Repeatability:
    """How well a limb repeats.

    Attributes:
        deviation: √N, of a tip's coordinate from run to run [m]; 0 before two runs were compared.
        share: ε.
        pairs: number of pairs that were compared.
    """

    deviation: float = 0.0
    share: float = _PRIOR_SHARE
    pairs: int = 0

    @property
    def distance(self) -> float:
        """Mean distance of a run's tip from the mean of many runs of the same plan [m]."""
        return float(np.sqrt(np.pi / 2) * self.deviation)

    def variance(self, movement: float) -> float:
        """Return the variance [m²] of what a run says of another plan Δ² (m²) away."""
        return self.deviation**2 + (self.share**2) * movement


def estimate(pairs: list[Pair]) -> Repeatability:
    """Return N and ε of the largest likelihood; see the module."""
    if not pairs:
        return Repeatability()
    least = _DEVIATIONS[0] ** 2
    share, deviation = np.meshgrid(_SHARES, _DEVIATIONS, indexing="ij")
    likelihood = -0.5 * (np.log(share / _PRIOR_SHARE) / np.log(_PRIOR_FACTOR)) ** 2
    # Each run takes part in many pairs, which together tell no more than as many runs do.
    runs = 0.5 + np.sqrt(0.25 + 2 * len(pairs))
    weight = (runs - 1) / len(pairs)
    for pair in pairs:
        expected = 2 * deviation**2 + share**2 * pair.movement + pair.noise + least
        ratio = (pair.difference + least) / expected
        likelihood += weight * 0.5 * _DEGREES * (np.log(ratio) - ratio)
    best = np.unravel_index(int(np.argmax(likelihood)), likelihood.shape)
    return Repeatability(float(deviation[best]), float(share[best]), len(pairs))
