"""Lengths of segments and stiff pieces from the tips and bend angles that tags have shown."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.logs.log import CalibrationLog, LogError
from der_planner.identification.rod_angles import Predicted
from der_planner.limb import Limb
from der_planner.model import NODES, RodModel, simulate
from der_planner.model.bending import PolylineKinematics
from der_planner.rod import ConvergenceError, Rod

Array = NDArray[np.float64]

LENGTH_PRIOR = 0.05
"""Relative standard deviation of how much of a segment bends: its fittings do not."""
LENGTH_RANGE = (0.8, 1.2)
"""Of a segment over the prior's."""
CONNECTOR_RANGE = (1e-3, 3e-2)
"""Of the connector [m]: the rod needs an edge there."""
BASE_RANGE = (0.0, 3e-2)
"""Of the stiff piece at the clamp [m]."""
STIFF_PRIOR = 0.01
"""Prior standard deviation of connector and base [m]."""
TIP_ERROR = 1e-3
"""Error of an evenly bent limb at single instants [m], from this bend on: a real one does not bend
quite evenly …"""
UNEVEN_BEND = 1.0
"""… [rad], and the less the straighter it is: the straight limb tells its whole length …"""
STRAIGHT_ERROR = 1e-4
"""… as well as the tags do [m]."""
UNEVEN_ERROR = 2e-3
"""Error of a tip where it tells stiffness [m]: what makes a limb bend unevenly beside its weight,
fittings and uneven walls, stays the same for the whole log and averages out less."""
CORRELATION = 20.0
"""Rows over which that error stays the same (1 s)."""
_AT_END = 1e-3
_NUDGE = 1e-6
"""Change of a length for the slope of the tip [m]."""
GIVES_WAY = (
    "the limb that fits the log best gives way under the pressures of the log: its stiffness falls "
    "too far as it bends. Fit it without that term (--terms without 'cubic'), or record a log with "
    "smaller pressures"
)


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
        nodes: of the rod whose chain of edges is fitted, by default those of the planners' rod. A
            polyline bends at its inner nodes alone and leaves a straight half edge at both ends of
            a segment; the fitted stiff pieces make up for that.
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
    start, spread, low, high = _known(limb)
    uneven_share = np.minimum(np.linalg.norm(angles, axis=1) / UNEVEN_BEND, 1.0)
    error = np.hypot(STRAIGHT_ERROR, TIP_ERROR * uneven_share)[:, None]
    weight = math.sqrt(every / CORRELATION) / error

    def difference(candidate: Limb) -> Array:
        return np.asarray(_even_tip(candidate, angles, nodes) - tip)

    def residual(x: Array) -> Array:
        data = (weight * difference(_with(limb, x))).ravel()
        return np.concatenate([data, (x - start) / spread])

    solution = least_squares(
        residual, np.clip(start, 1.1 * low, 0.9 * high), bounds=(low, high), x_scale=spread
    )
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    found = _with(limb, solution.x)
    return GeometryFit(
        lengths=np.array([segment.length for segment in found.segments]),
        connector=found.connector_length,
        base=found.base_length,
        uncertainty=np.sqrt(np.diag(covariance)),
        residual_before=_distance(difference(limb)),
        residual=_distance(difference(found)),
    )


class Unevenness(NamedTuple):
    """How unevenly its weight bends a limb along a log, as its tip shows it.

    Attributes:
        tip: (K, 2) less that of evenly bent segments [m].
        lacking: (K, 2) what the rod of the fit lacks of it [m].
        holds: whether the rod of the planners follows the log.
    """

    tip: Array
    lacking: Array
    holds: bool


def unevenness(limb: Limb, time: Array, pressure: Array, nodes: int) -> Unevenness:
    """Return how unevenly a fitted limb bends.

    A limb whose stiffness falls as it bends may give way in the rod of the
    planners, whose many nodes see a sharper bend at the clamp, although the rod of the fit follows
    the log. Then the rod of the fit tells it alone and lacks nothing: the next fit has better
    lengths, and by them a better stiffness.

    Args:
        limb: that was fitted.
        time: (K,) of the log [s].
        pressure: (K, M) differential pressures inside the chambers [Pa].
        nodes: of the rod in the fit.

    Raises:
        LogError: not even the rod of the fit follows the log.
    """
    coarse = _uneven_tip(limb, time, pressure, nodes)
    try:
        whole = _uneven_tip(limb, time, pressure, NODES)
    except LogError:
        return Unevenness(coarse, np.zeros_like(coarse), holds=False)
    return Unevenness(whole, whole - coarse, holds=True)


def check_that_it_holds(limb: Limb, time: Array, pressure: Array) -> None:
    """Refuse a limb that the rod of the planners cannot follow along a log; as in `unevenness`.

    Raises:
        LogError: it gives way under the pressures of the log.
    """
    _uneven_tip(limb, time, pressure, NODES)


def _uneven_tip(limb: Limb, time: Array, pressure: Array, nodes: int) -> Array:
    model = RodModel(limb, nodes)
    try:
        seen = simulate(model, time, pressures=pressure)
    except ConvergenceError as error:
        raise LogError(GIVES_WAY) from error
    uneven: Array = seen.tip - model.kinematics.tip(seen.bend_angles)
    return uneven


class UnevenTips:
    """The residual of the tips that tells the weight's share in the bend, for the best lengths.

    A pressure and a rest angle bend a segment evenly, weight bends it most where it begins. So the
    tip at given bend angles tells how much of them is the weight's, which bend angles alone hardly
    tell from a rest angle and the neighbour's pressure. Lengths shift the tip as well: the residual
    is what the best lengths leave, and it changes by an unknown as it does with them.

    Args:
        prior: with the lengths that are known before.
        limb: with the lengths that were fitted last.
        log: with tips and bend angles on the rows of the fit.
        usable: (K,) rows to fit to.
        model: of the limb, with the nodes of the fit.
        finer: (K, 2) tip less that of an evenly bent limb of a rod of many nodes, less the same of
            the model's [m].
    """

    def __init__(
        self,
        prior: Limb,
        limb: Limb,
        log: CalibrationLog,
        usable: NDArray[np.bool_],
        model: RodModel,
        finer: Array,
    ) -> None:
        seen = np.all(np.isfinite(log.bend_angles), axis=1) & np.all(np.isfinite(log.tip), axis=1)
        self._rows, self._even = usable & seen, model.kinematics
        angles = log.bend_angles[self._rows]
        tip = _even_tip(limb, angles, NODES)
        self._uneven = (log.tip - finer)[self._rows] - tip
        self._weight = 1.0 / (UNEVEN_ERROR * math.sqrt(CORRELATION))
        start, spread, low, high = _known(prior)
        now = _lengths_of(limb)
        # A length at its bound stays there.
        free = np.flatnonzero((now - low > _NUDGE) & (high - now > _NUDGE))
        longer = [_with(limb, now + _NUDGE * np.eye(len(now))[place]) for place in free]
        columns = [(_even_tip(each, angles, NODES) - tip).ravel() / _NUDGE for each in longer]
        slopes = np.reshape(columns, (len(free), tip.size)).T
        by_lengths = np.concatenate([self._weight * slopes, np.diag(1.0 / spread[free])])
        self._known = ((now - start) / spread)[free]
        self._spanned = np.linalg.qr(by_lengths)[0]

    def residual(self, found: Predicted | None) -> Array:
        """Return the weighted residual of a prediction; zeros for None, a trial without one."""
        if found is None:
            return np.zeros(len(self._spanned))
        uneven = (found.tip - self._even.tip(found.angles))[self._rows]
        data = self._weight * (uneven - self._uneven).ravel()
        return self._left(np.concatenate([data, self._known]))

    def jacobian(self, found: Predicted) -> Array:
        """Return the derivative of the residual by the P unknowns."""
        rows, unknowns = self._rows, found.tip_by.shape[2]
        evenly = self._even.tip_jacobians(found.angles[rows]) @ found.angles_by[rows]
        change = self._weight * (found.tip_by[rows] - evenly).reshape(-1, unknowns)
        return self._left(np.concatenate([change, np.zeros((len(self._known), unknowns))]))

    def _left(self, rows: Array) -> Array:
        left: Array = rows - self._spanned @ (self._spanned.T @ rows)
        return left


def _known(prior: Limb) -> tuple[Array, Array, Array, Array]:
    """Return where lengths, base and connector start, their spreads and bounds [m].

    Without the connector for one segment.
    """
    lengths = np.array([segment.length for segment in prior.segments])
    count = len(lengths) + (2 if prior.segment_count > 1 else 1)
    start = np.concatenate([lengths, [prior.base_length, prior.connector_length or 4e-3]])
    spread = np.concatenate([LENGTH_PRIOR * lengths, [STIFF_PRIOR, STIFF_PRIOR]])
    low = np.concatenate([LENGTH_RANGE[0] * lengths, [BASE_RANGE[0], CONNECTOR_RANGE[0]]])
    high = np.concatenate([LENGTH_RANGE[1] * lengths, [BASE_RANGE[1], CONNECTOR_RANGE[1]]])
    return start[:count], spread[:count], low[:count], high[:count]


def lengths_at_their_end(prior: Limb, lengths: Array) -> str:
    """Return a sentence where the lengths (M,) of segments went as far as they may; else empty."""
    measured = np.array([segment.length for segment in prior.segments])
    share = lengths / measured
    ends = (share < LENGTH_RANGE[0] + _AT_END) | (share > LENGTH_RANGE[1] - _AT_END)
    if not ends.any():
        return ""
    named = ", ".join(
        f"segment {index} is given as {1e3 * measured[index]:.0f} mm and was found to be "
        f"{1e3 * lengths[index]:.0f} mm" + (" or less" if share[index] < 1 else " or more")
        for index in np.flatnonzero(ends)
    )
    return (
        f"lengths as far from the prior's as they may be: {named}. Measure the segments and give "
        "their lengths in the limb file of --prior; check the unit and the origin of the tips"
    )


def _lengths_of(limb: Limb) -> Array:
    lengths = [*(s.length for s in limb.segments), limb.base_length]
    return np.array([*lengths, limb.connector_length] if limb.segment_count > 1 else lengths)


def _with(limb: Limb, lengths: Array) -> Limb:
    """Return the limb with lengths, base and connector as `_known` orders them."""
    count = limb.segment_count
    connector = float(lengths[-1]) if count > 1 else None
    return with_geometry(limb, lengths[:count], connector, float(lengths[count]))


def _even_tip(limb: Limb, angles: Array, nodes: int) -> Array:
    """Return the tips (K, 2) of the limb's polyline, bent evenly by angles (K, M) [m]."""
    return PolylineKinematics.of_rod(Rod.from_limb(limb, nodes)).tip(angles)


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
