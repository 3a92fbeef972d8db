"""What repeats from run to run, told from what does not.

Two runs i, j of a limb show disturbances that differ by what does not repeat (variance N of a run)
and by what the model's answer to a change of commands lacks, a share ε of the movement Δ that the
change makes:

    E |d_i − d_j|² = 2 N + ε² Δ_ij²        a coordinate, mean over the motion

Runs of one plan have Δ = 0 and show N alone. N and ε are those of the largest likelihood over all
pairs, on a grid, with a prior for ε. A disturbance wanders slowly, so that the mean square of a
pair counts as that of a few independent numbers only.

`Runs` holds the runs of one motion and weighs them against each other by this.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.control.disturbance import Shown, without_gaps
from der_planner.planning.correction import Expected

_DEGREES = 4.0
"""Independent numbers in the difference of two runs."""
_PRIOR_SHARE = 0.1
"""ε that is expected before runs were compared: hysteresis makes small changes stiffer."""
_PRIOR_FACTOR = 3.0
"""One standard deviation of ln ε is the logarithm of this."""
_FADE = 2.0
"""Time in which the disturbance fades beyond the first and last picture [s]."""
_UNLIKE = 4.0
"""Difference of a run from the others beyond which it is not one of them [standard deviations]."""
_NOTABLE = 1.5e-3
"""Difference of a run from the others that always is too small to tell, root mean square [m]."""
_SHARES = np.geomspace(0.003, 3.0, 61)
_DEVIATIONS = np.geomspace(3e-6, 3e-2, 81)


@dataclass(frozen=True)
class Repeatability:
    """How well a limb repeats.

    Attributes:
        deviation: √N, of a tip's coordinate from run to run [m]; 0 before two runs were compared.
        share: ε.
    """

    deviation: float = 0.0
    share: float = _PRIOR_SHARE

    @property
    def distance(self) -> float:
        """Mean distance of a run's tip from the mean of many runs of the same plan [m]."""
        return float(np.sqrt(np.pi / 2) * self.deviation)

    def variance(self, movement: float) -> float:
        """Return the variance [m²] of what a run says of another plan Δ² (m²) away."""
        return self.deviation**2 + (self.share**2) * movement


def estimate(pairs: list[tuple[float, float, float]]) -> Repeatability:
    """Return N and ε of the largest likelihood; see the module.

    Args:
        pairs: of two runs each, the mean square of the difference of their disturbances, the part
            of it that the camera's noise explains, and Δ², a coordinate [m²].
    """
    if not pairs:
        return Repeatability()
    least = _DEVIATIONS[0] ** 2
    share, deviation = np.meshgrid(_SHARES, _DEVIATIONS, indexing="ij")
    likelihood = -0.5 * (np.log(share / _PRIOR_SHARE) / np.log(_PRIOR_FACTOR)) ** 2
    # Each run takes part in many pairs, which together tell no more than as many runs do.
    runs = 0.5 + np.sqrt(0.25 + 2 * len(pairs))
    weight = (runs - 1) / len(pairs)
    for difference, noise, movement in pairs:
        expected = 2 * deviation**2 + share**2 * movement + noise + least
        ratio = (difference + least) / expected
        likelihood += weight * 0.5 * _DEGREES * (np.log(ratio) - ratio)
    best = np.unravel_index(int(np.argmax(likelihood)), likelihood.shape)
    return Repeatability(float(deviation[best]), float(share[best]))


# The runs themselves ---------------------------------------------------------------------------


@dataclass(frozen=True)
class PlayedRun:
    """A run that can be used.

    Attributes:
        commands: (K, M) that were in force [Pa].
        expected: what the model expects under them.
        shown: what the run showed beyond that.
    """

    commands: Array
    expected: Expected
    shown: Shown


@dataclass(frozen=True)
class Known:
    """What all runs together say of the disturbance under one plan.

    Attributes:
        value: D (K, 2), with gaps bridged [m].
        seen: (K,) where it was measured.
        runs: number of runs that it is worth, had they all been of this plan.
        variance: of a coordinate, mean over the motion [m²].
    """

    value: Array
    seen: NDArray[np.bool_]
    runs: float
    variance: float


class Runs:
    """All runs of one motion of one limb, and the disturbance that they show together.

    Args:
        reference: r̄ (K, 2) at the setpoints [m].
        period: of the setpoints [s].
        tip_per_pressure: movement of the tip per pressure [m/Pa].
    """

    def __init__(self, reference: Array, period: float, tip_per_pressure: float) -> None:
        self._reference, self._period, self._tip_per_pressure = reference, period, tip_per_pressure
        self._all: list[PlayedRun] = []
        self.repeats = Repeatability()

    def add(self, run: PlayedRun) -> None:
        """Take in a run."""
        self._all.append(run)
        self.repeats = estimate(self._pairs())

    @property
    def repeated(self) -> bool:
        """Whether two runs were of one plan, which alone show N."""
        pairs = itertools.combinations(self._all, 2)
        return any(np.array_equal(one.commands, other.commands) for one, other in pairs)

    def expected(self, commands: Array) -> Expected | None:
        """Return what the model expects under commands that were played; None: never played."""
        played = (run.expected for run in self._all if np.array_equal(run.commands, commands))
        return next(played, None)

    def known(self, about: PlayedRun) -> Known:
        """Return what all runs say of the disturbance under the commands of one run."""
        count = len(self._reference)
        total, weights, squares = np.zeros((count, 2)), np.zeros(count), np.zeros(count)
        for run in self._all:
            movement = self._movement(run.expected.pressure - about.expected.pressure)
            doubt = self.repeats.variance(movement) + run.shown.variance
            weight = np.where(run.shown.seen, 1.0 / np.maximum(doubt, 1e-14), 0.0)
            total += weight[:, None] * np.nan_to_num(run.shown.value)
            weights += weight
            squares += weight**2
        seen = weights > 0
        value = total / np.where(seen, weights, 1.0)[:, None]
        runs = float((weights[seen] ** 2 / squares[seen]).mean()) if seen.any() else 0.0
        variance = float((1.0 / weights[seen]).mean()) if seen.any() else 0.0
        return Known(without_gaps(value, seen, self._period, _FADE), seen, runs, variance)

    def error(self, run: PlayedRun) -> Array:
        """Return what all runs say that the commands of one leave: tip less r̄ (K, 2) [m]."""
        return run.expected.tip + self.known(run).value - self._reference

    def level(self, run: PlayedRun) -> float:
        """Return the mean distance from r̄ that all runs say the commands of one leave [m]."""
        return float(np.linalg.norm(self.error(run), axis=1).mean())

    def missed(self, run: PlayedRun) -> float:
        """Return the mean distance from r̄ that a run by itself showed [m]."""
        left = (run.expected.tip + run.shown.value - self._reference)[run.shown.seen]
        return float(np.linalg.norm(left, axis=1).mean())

    def unlike(self, run: PlayedRun) -> str:
        """Return how a run differs from all others; empty if it is one of them."""
        if not self._all:
            return ""
        known = self.known(run)
        both = known.seen & run.shown.seen
        if not both.any():
            return ""
        apart = _rms(run.shown.value[both] - known.value[both])
        noise = self.repeats.deviation**2 + known.variance + run.shown.variance[both].mean()
        if len(self._all) == 1:
            # What repeats is not known yet: no worse, surely, than the first run's error shows.
            noise += _rms(self.error(self._all[0])[both]) ** 2
        if apart < max(_UNLIKE * np.sqrt(noise), _NOTABLE):
            return ""
        return f"it differs from the runs before by {apart * 100:.2f} cm"

    def differ(self, one: PlayedRun, other: PlayedRun) -> bool:
        """Tell whether two runs that are unlike the others are unlike each other, too."""
        both = one.shown.seen & other.shown.seen
        known = self.known(one)
        from_others = _rms((one.shown.value - known.value)[both & known.seen])
        return _rms((one.shown.value - other.shown.value)[both]) > 0.5 * from_others

    def doubt(self, change: Array) -> float:
        """Return how far the tip may be, on average, from what is expected of other commands [m].

        Args:
            change: (K, M) of the commands [Pa].
        """
        return float(np.sqrt(np.pi / 2 * self._movement(change))) * self.repeats.share

    def _movement(self, change: Array) -> float:
        """Return how far a change of pressures (K, M) [Pa] moves the tip, squared [m²].

        It is that of a coordinate, segment by segment.
        """
        return float((change**2).sum(axis=1).mean()) / 2 * self._tip_per_pressure**2

    def _pairs(self) -> list[tuple[float, float, float]]:
        """Return what `estimate` compares of every two runs."""
        result = []
        for one, other in itertools.combinations(self._all, 2):
            both = one.shown.seen & other.shown.seen
            if both.any():
                apart = one.shown.value[both] - other.shown.value[both]
                noise = one.shown.variance[both].mean() + other.shown.variance[both].mean()
                moved = self._movement(one.expected.pressure - other.expected.pressure)
                result.append((_rms(apart) ** 2, float(noise), moved))
        return result


def _rms(values: Array) -> float:
    """Return the root mean square of a coordinate."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
