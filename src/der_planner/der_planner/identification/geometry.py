"""Lengths of the segments from tips and bend angles: where the tags sit on the rod."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.log import CalibrationLog
from der_planner.limb import Limb
from der_planner.pcc import Pcc

Array = NDArray[np.float64]

LENGTH_PRIOR = 0.02
"""Relative standard deviation of a length measured with a ruler."""
TIP_ERROR = 1e-3
"""Error of arcs at single instants [m]: the limb does not bend quite evenly."""

CORRELATION = 20.0
"""Rows over which that error stays the same (1 s)."""


@dataclass(frozen=True)
class GeometryFit:
    """Lengths that explain the tips.

    Attributes:
        lengths: (M,) [m].
        uncertainty: (M,) standard deviations [m].
        residual_before, residual: root mean square tip error of arcs with the prior's and the fitted
            lengths [m].
    """

    lengths: Array
    uncertainty: Array
    residual_before: float
    residual: float


def fit_geometry(limb: Limb, log: CalibrationLog) -> GeometryFit | None:
    """Fit the segment lengths to tips at given bend angles; None where the log has no tips."""
    rows = np.all(np.isfinite(log.bend_angles), axis=1) & np.all(np.isfinite(log.tip), axis=1)
    if np.count_nonzero(rows) < 20:
        return None
    every = max(1, np.count_nonzero(rows) // 800)
    angles, tip = log.bend_angles[rows][::every], log.tip[rows][::every]
    prior = np.array([segment.length for segment in limb.segments])
    weight = np.sqrt(every / CORRELATION) / TIP_ERROR

    def difference(lengths: Array) -> Array:
        return np.asarray(Pcc(with_lengths(limb, lengths)).tip(angles) - tip)

    def residual(relative: Array) -> Array:
        data = weight * difference(prior * relative).ravel()
        return np.concatenate([data, (relative - 1.0) / LENGTH_PRIOR])

    solution = least_squares(residual, np.ones(len(prior)), bounds=(0.8, 1.2))
    covariance = np.linalg.inv(solution.jac.T @ solution.jac)
    lengths = prior * solution.x
    return GeometryFit(
        lengths=lengths,
        uncertainty=prior * np.sqrt(np.diag(covariance)),
        residual_before=_distance(difference(prior)),
        residual=_distance(difference(lengths)),
    )


def with_lengths(limb: Limb, lengths: Array) -> Limb:
    """Return the limb with these segment lengths (M,) [m]."""
    segments = tuple(
        replace(segment, length=float(length))
        for segment, length in zip(limb.segments, lengths, strict=True)
    )
    return replace(limb, segments=segments)


def _distance(difference: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
