"""The rows of a study: a grid of values, times draws of the factors that are given as ranges.

scipy.stats takes most of a second to import: only who draws with it pays for it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.studies.errors import StudyError
from der_planner.studies.factors import Value

Array = NDArray[np.float64]
METHODS = ("random", "sobol", "saltelli")
"""Independent draws; a Sobol sequence; one arranged for Sobol indices (see `saltelli`)."""
SCALES = ("even", "log", "normal")


@dataclass(frozen=True)
class Spread:
    """What a drawn factor is drawn from.

    Attributes:
        scale: "even" or "log" between low and high, or "normal" with mean ``low`` and standard
            deviation ``high``.
        whole: rounded down to whole numbers.
    """

    low: float
    high: float
    scale: str = "even"
    whole: bool = False

    def value(self, share: float) -> Value:
        """Return the value below which ``share`` (0 … 1) of the draws lie."""
        if self.scale == "normal":
            from scipy.stats import norm  # noqa: PLC0415

            return float(norm.ppf(share, self.low, self.high))
        if self.scale == "log":
            return float(self.low * math.exp(share * math.log(self.high / self.low)))
        if self.whole:
            return min(int(self.low) + int(share * (self.high - self.low + 1)), int(self.high))
        return float(self.low + share * (self.high - self.low))


@dataclass(frozen=True)
class Draw:
    """How often and how the ranges are drawn from."""

    method: str = "sobol"
    count: int = 1
    seed: int = 0

    def shares(self, dimensions: int) -> Array:
        """Return points (draws, dimensions) in the open unit cube, the same for the same seed."""
        if self.method == "random":
            points = np.random.default_rng(self.seed).random((self.count, dimensions))
        elif self.method == "sobol":
            points = _sobol(dimensions, self.count, self.seed)
        else:
            points = saltelli(dimensions, self.count, self.seed)
        inside: Array = np.clip(points, 1e-12, 1.0 - 1e-12)
        return inside


def _sobol(dimensions: int, count: int, seed: int) -> Array:
    from scipy.stats import qmc  # noqa: PLC0415

    sequence = qmc.Sobol(dimensions, rng=np.random.default_rng(seed))
    points: Array = sequence.random_base2(int(math.log2(count)))
    return points


def saltelli(dimensions: int, count: int, seed: int) -> Array:
    """Return (count · (dimensions + 2), dimensions) points from which Sobol indices are found.

    Two samples A and B, and for each dimension A with this column of B (Saltelli et al., "Variance
    based sensitivity analysis of model output", Comput. Phys. Commun. 181, 2010): first all of A,
    then B, then the mixed ones, as `scipy.stats.sobol_indices` takes their results.
    """
    both = _sobol(2 * dimensions, count, seed)
    a, b = both[:, :dimensions], both[:, dimensions:]
    mixed = []
    for column in range(dimensions):
        table = a.copy()
        table[:, column] = b[:, column]
        mixed.append(table)
    return np.concatenate([a, b, *mixed])


def rows(
    grid: Mapping[str, Sequence[Value]], spreads: Mapping[str, Spread], draw: Draw
) -> list[dict[str, Value]]:
    """Return every row: the grid's first factor changes slowest, the draws fastest."""
    drawn: list[dict[str, Value]] = [{}]
    if spreads:
        points = draw.shares(len(spreads))
        drawn = [
            {
                name: spread.value(float(share))
                for (name, spread), share in zip(spreads.items(), point, strict=True)
            }
            for point in points
        ]
    combinations = itertools.product(*grid.values())
    return [
        dict(zip(grid, values, strict=True)) | each for values in combinations for each in drawn
    ]


def check_draw(draw: Draw, spreads: Mapping[str, Spread], combinations: int) -> None:
    """Refuse draws that cannot be made.

    Raises:
        StudyError: names the key.
    """
    if draw.method not in METHODS:
        raise StudyError(f"draw.method must be one of {', '.join(METHODS)}, got {draw.method!r}")
    power = draw.count & (draw.count - 1) == 0
    if draw.method != "random" and not power:
        nearest = 2 ** round(math.log2(draw.count))
        raise StudyError(
            f"draw.count must be a power of two for {draw.method}, got {draw.count}: "
            f"choose {nearest}, or method random"
        )
    if draw.method == "saltelli" and combinations != 1:
        raise StudyError(
            f"draw.method saltelli goes with one value of every other factor, and these make "
            f"{combinations} combinations: write one study for each"
        )
    if draw.method == "saltelli" and len(spreads) < 2:
        raise StudyError("draw.method saltelli needs two drawn factors or more")
