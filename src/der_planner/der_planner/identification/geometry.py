"""Lengths of segments and stiff pieces from the tips and bend angles that tags have shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.logs.log import CalibrationLog
from der_planner.limb import Limb
from der_planner.model.bending import PolylineKinematics
from der_planner.rod import Rod

Array = NDArray[np.float64]

LENGTH_PRIOR = 0.05
"""Relative standard deviation of how much of a segment bends: its fittings do not."""
CONNECTOR_RANGE = (1e-3, 3e-2)
"""Of the connector [m]: the rod needs an edge there."""
BASE_RANGE = (0.0, 3e-2)
"""Of the stiff piece at the clamp [m]."""
STIFF_PRIOR = 0.01
"""Standard deviation of what is known of connector and base before [m]."""
TIP_ERROR = 1e-3
"""Error of an evenly bent limb at single instants [m], from this bend on: a real one does not bend
quite evenly …"""
UNEVEN_BEND = 1.0
"""… [rad], and the less the straighter it is: the straight limb tells its whole length …"""
STRAIGHT_ERROR = 1e-4
"""… as well as the tags do [m]."""
CORRELATION = 20.0
"""Rows over which that error stays the same (1 s)."""
NODES = 21
"""Of the rod whose chain of edges is fitted, as the planners use it. A polyline bends at its inner
nodes alone and leaves a straight half edge at both ends of a segment; the fitted stiff pieces make
up for that."""


@dataclass(frozen=True)
class GeometryFit:
    """Lengths that explain the tips.

    Attributes:
        lengths: (M,) [m].
        connector: between two segments [m]; the prior's for one segment.
        base: between clamp and first segment [m].
        uncertainty: (M + 2,) standard deviations of lengths, base and connector [m]; without the
            connector for one segment.
        residual_before, residual: root mean square distance of the tips from those of an evenly
            bent rod with the prior's and with the fitted lengths [m].
    """

    lengths: Array
    connector: float
    base: float
    uncertainty: Array
    residual_before: float
    residual: float


def fit_geometry(
    limb: Limb, log: CalibrationLog, nodes: int = NODES, uneven: Array | None = None
) -> GeometryFit | None:
    """Fit the lengths to tips at given bend angles; None where the log has no tips.

    Args:
        limb: the prior.
        log: with tips and bend angles.
        nodes: of the rod.
        uneven: (K, 2) tip of the limb less that of an evenly bent one at the same bend angles, as
            its weight bends it [m]; None: it bends evenly.
    """
    rows = np.all(np.isfinite(log.bend_angles), axis=1) & np.all(np.isfinite(log.tip), axis=1)
    if np.count_nonzero(rows) < 20:
        return None
    every = max(1, int(np.count_nonzero(rows)) // 800)
    angles, tip = log.bend_angles[rows][::every], log.tip[rows][::every]
    if uneven is not None:
        tip = tip - uneven[rows][::every]
    prior = np.array([segment.length for segment in limb.segments])
    known = limb.connector_length or 4e-3
    connector = min(max(known, 1.1 * CONNECTOR_RANGE[0]), 0.9 * CONNECTOR_RANGE[1])
    several = limb.segment_count > 1
    base = min(max(limb.base_length, 1e-3), 0.9 * BASE_RANGE[1])
    spread = np.concatenate([LENGTH_PRIOR * prior, [STIFF_PRIOR, STIFF_PRIOR]])
    start = np.concatenate([prior, [base, connector]])
    low = np.concatenate([0.8 * prior, [BASE_RANGE[0], CONNECTOR_RANGE[0]]])
    high = np.concatenate([1.2 * prior, [BASE_RANGE[1], CONNECTOR_RANGE[1]]])
    uneven_share = np.minimum(np.linalg.norm(angles, axis=1) / UNEVEN_BEND, 1.0)
    error = np.hypot(STRAIGHT_ERROR, TIP_ERROR * uneven_share)[:, None]
    weight = math.sqrt(every / CORRELATION) / error
    count = len(prior)
    free = count + 2 if several else count + 1

    def difference(candidate: Limb) -> Array:
        rod = Rod.from_limb(candidate, nodes)
        return np.asarray(PolylineKinematics.of_rod(rod).tip(angles) - tip)

    def candidate(x: Array) -> Limb:
        return with_geometry(limb, x[:count], float(x[-1]) if several else None, float(x[count]))

    def residual(x: Array) -> Array:
        data = (weight * difference(candidate(x))).ravel()
        return np.concatenate([data, (x - start[:free]) / spread[:free]])

    solution = least_squares(
        residual, start[:free], bounds=(low[:free], high[:free]), x_scale=spread[:free]
    )
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    found = candidate(solution.x)
    return GeometryFit(
        lengths=np.array([segment.length for segment in found.segments]),
        connector=found.connector_length,
        base=found.base_length,
        uncertainty=np.sqrt(np.diag(covariance)),
        residual_before=_distance(difference(limb)),
        residual=_distance(difference(found)),
    )


def with_geometry(
    limb: Limb, lengths: Array, connector: float | None = None, base: float | None = None
) -> Limb:
    """Return the limb with these lengths (M,), connector and base [m]; None keeps the old.

    What the limb carries stays where it is on its segment or connector.
    """
    segments = tuple(
        replace(segment, length=float(length))
        for segment, length in zip(limb.segments, lengths, strict=True)
    )
    kept = limb.connector_length if connector is None else connector
    start = limb.base_length if base is None else base
    bare = replace(limb, segments=segments, connector_length=kept, base_length=start, masses=())
    places = np.interp([m.arc_length for m in limb.masses], _joints(limb), _joints(bare))
    masses = [
        replace(item, arc_length=float(place))
        for item, place in zip(limb.masses, places, strict=True)
    ]
    return replace(bare, masses=tuple(masses))


def _joints(limb: Limb) -> Array:
    """Return the arc lengths of the clamp and of the ends of base, segments and connectors [m]."""
    pieces = [0.0, limb.base_length]
    for index, segment in enumerate(limb.segments):
        pieces += [limb.connector_length if index else 0.0, segment.length]
    return np.cumsum(pieces)


def _distance(difference: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(difference**2, axis=1))))
