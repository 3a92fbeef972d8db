"""Lengths of segments and stiff pieces from the tips and bend angles that tags have shown."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array, rms_distance
from der_planner.identification.bends import CORRELATION, Predicted, follow
from der_planner.identification.least_squares import (
    LeastSquares,
    Rows,
    Unknowns,
    with_differences,
)
from der_planner.identification.log import CalibrationLog, LogError, Prepared
from der_planner.limb import Limb
from der_planner.model import NODES, RodModel
from der_planner.rod import ConvergenceError

LENGTH_PRIOR = 0.05
"""Relative standard deviation of how much of a segment bends: its fittings do not."""
LENGTH_RANGE = (0.8, 1.2)
"""Least and largest fitted length of a segment, over the prior's."""
CONNECTOR_RANGE = (1e-3, 3e-2)
"""Least and largest fitted length of the connector [m]: the rod needs an edge there."""
BASE_RANGE = (0.0, 3e-2)
"""Least and largest fitted length of the stiff piece at the clamp [m]."""
STIFF_PRIOR = 0.01
"""Prior standard deviation of connector and base [m]."""
STRAIGHT_ERROR = 1e-4
"""Error of the tip of a straight limb [m], which shows its whole length as well as tags can."""
TIP_ERROR = 1e-3
"""Error of the tip of a limb bent by `UNEVEN_BEND` or more [m]: a real one bends unevenly."""
UNEVEN_BEND = 1.0
"""Bend from which on a tip has `TIP_ERROR`; below it the error falls to `STRAIGHT_ERROR` [rad]."""
UNEVEN_ERROR = 8e-3
"""Error of a tip where it tells stiffness [m]: what makes a limb bend unevenly beside its weight,
fittings and uneven walls, is 1 mm, but stays the same for the whole log and never averages out."""
FEWEST_TIPS = 20
"""Rows with tips that a log needs to tell lengths."""
MOST_TIPS = 800
"""Rows with tips, evenly chosen, to which lengths are fitted."""
_NUDGE = 1e-6
"""Change of a length for the slope of the tip [m]."""


class GivesWayError(LogError):
    """A limb whose stiffness falls so far as it bends that it gives way to the log's pressures."""


@dataclass(frozen=True)
class GeometryFit:
    """Lengths that explain the tips.

    Attributes:
        limb: with the fitted lengths.
        uncertainty: (M + 2,) standard deviations of lengths, base and connector [m]; without the
            connector for one segment.
        residual_before, residual: root mean square distance of the tips from those of an evenly
            bent rod with the prior's and with the fitted lengths [m].
    """

    limb: Limb
    uncertainty: Array
    residual_before: float
    residual: float


def fit_geometry(
    limb: Limb, log: CalibrationLog, uneven: Array | None = None
) -> GeometryFit | None:
    """Fit the lengths to tips at given bend angles; None where the log has no tips.

    The chain of edges that is fitted is that of the planners' rod. A polyline bends at its inner
    nodes alone and leaves a straight half edge at both ends of a segment; the fitted stiff pieces
    make up for that.

    Args:
        limb: the prior.
        log: with tips and bend angles.
        uneven: (K, 2) tip of the limb less that of an evenly bent one at the same bend angles, as
            its weight bends it [m]; None: it bends evenly.
    """
    rows = np.flatnonzero(_seen(log))
    if len(rows) < FEWEST_TIPS:
        return None
    every = max(1, len(rows) // MOST_TIPS)
    rows = rows[::every]
    angles = log.bend_angles[rows]
    tip = log.tip[rows] - (0.0 if uneven is None else uneven[rows])
    bent = np.minimum(np.linalg.norm(angles, axis=1) / UNEVEN_BEND, 1.0)
    error = np.hypot(STRAIGHT_ERROR, TIP_ERROR * bent)[:, None]
    weight = math.sqrt(every / CORRELATION) / error
    unknowns = _known(limb)

    def difference(candidate: Limb) -> Array:
        return np.asarray(_even_tip(candidate, angles) - tip)

    def residual(lengths: Array) -> Array:
        return np.asarray(weight * difference(with_lengths(limb, lengths))).ravel()

    def rows_of(lengths: Array) -> Rows:
        return with_differences(residual, lengths, np.full(len(lengths), _NUDGE))

    search = LeastSquares(unknowns, rows_of, cheap=True)
    best = search.solve()
    found = with_lengths(limb, best)
    return GeometryFit(
        limb=found,
        uncertainty=np.sqrt(np.diag(search.covariance(best))),
        residual_before=rms_distance(difference(limb)),
        residual=rms_distance(difference(found)),
    )


def unevenness(limb: Limb, log: Prepared, nodes: int) -> tuple[Array, Array]:
    """Return how unevenly its weight bends a limb along a log, as its tip shows it.

    Args:
        limb: that was fitted.
        log: with the differential pressures inside the chambers.
        nodes: of the rod in the fit.

    Returns:
        Tip (K, 2) less that of evenly bent segments, and what the rod of the fit lacks of it [m].

    Raises:
        GivesWayError: see `uneven_tip`.
    """
    whole = uneven_tip(limb, log)
    return whole, whole - uneven_tip(limb, log, nodes)


def uneven_tip(limb: Limb, log: Prepared, nodes: int = NODES) -> Array:
    """Return the tip (K, 2) of a limb along a log, less that at evenly bent segments [m].

    Raises:
        GivesWayError: the limb gives way. The rod of the planners, whose many nodes see a sharper
            bend at the clamp, may do so where the rod of the fit follows the log.
    """
    model = RodModel(limb, nodes)
    try:
        response = follow(model, log)
    except ConvergenceError as error:
        raise GivesWayError(
            "the limb that fits the log best gives way under its pressures: record a log with "
            "smaller pressures"
        ) from error
    return np.asarray(response.tip - model.kinematics.tip(response.bend_angles))


def uneven_tips(
    prior: Limb, model: RodModel, log: Prepared, lacking: Array
) -> Callable[[Predicted], Rows]:
    """Return the residual of tips, for the best lengths, that tells the weight's share in the bend.

    A pressure and a rest angle bend a segment evenly, weight bends it most where it begins. So the
    tip at given bend angles tells how much of them is the weight's, which bend angles alone hardly
    tell from a rest angle and the neighbour's pressure. Lengths shift the tip as well: the residual
    is what the best lengths leave, and it changes by an unknown as it does with them.

    Args:
        prior: with the lengths that are known before.
        model: of the limb with the lengths that were fitted last.
        log: with tips and bend angles.
        lacking: (K, 2) of the tip, as `unevenness` gives it [m].

    Returns:
        The weighted residual of a prediction, and what gives its derivatives.
    """
    seen, even, limb = log.usable & _seen(log.log), model.kinematics, model.limb
    angles, weight = log.log.bend_angles[seen], 1.0 / (UNEVEN_ERROR * math.sqrt(CORRELATION))
    tip = _even_tip(limb, angles)
    measured = (log.log.tip - lacking)[seen] - tip
    known, now = _known(prior), lengths_of(limb)
    # A length at its bound stays there.
    free = np.flatnonzero((now - known.low > _NUDGE) & (known.high - now > _NUDGE))
    longer = [with_lengths(limb, now + _NUDGE * np.eye(len(now))[place]) for place in free]
    columns = [(_even_tip(each, angles) - tip).ravel() / _NUDGE for each in longer]
    slopes = np.reshape(columns, (len(free), tip.size)).T
    by_lengths = np.concatenate([weight * slopes, np.diag(1.0 / known.spread[free])])
    of_prior = ((now - known.prior) / known.spread)[free]
    spanned = np.linalg.qr(by_lengths)[0]

    def left(by_tip: Array, by_prior: Array) -> Array:
        every = np.concatenate([weight * by_tip, by_prior])
        return np.asarray(every - spanned @ (spanned.T @ every))

    def rows(found: Predicted) -> Rows:
        uneven = (found.tip - even.tip(found.angles))[seen] - measured

        def by_unknowns() -> Array:
            angles_by, tip_by = found.by
            evenly = even.tip_jacobians(found.angles[seen]) @ angles_by[seen]
            by = (tip_by[seen] - evenly).reshape(-1, tip_by.shape[2])
            return left(by, np.zeros((len(of_prior), by.shape[1])))

        return left(uneven.ravel(), of_prior), by_unknowns

    return rows


def _seen(log: CalibrationLog) -> NDArray[np.bool_]:
    """Return the rows (K,) with all bend angles and a tip."""
    return np.asarray(np.isfinite(np.column_stack([log.bend_angles, log.tip])).all(axis=1))


def _known(prior: Limb) -> Unknowns:
    """Return what is known of lengths, base and connector [m]; no connector for one segment."""
    lengths = np.array([segment.length for segment in prior.segments])
    stiff = len(lengths_of(prior)) - len(lengths)
    spread = np.append(LENGTH_PRIOR * lengths, [STIFF_PRIOR] * stiff)
    low, high = (
        np.append(share * lengths, [base, connector][:stiff])
        for share, base, connector in zip(LENGTH_RANGE, BASE_RANGE, CONNECTOR_RANGE, strict=True)
    )
    start = np.append(lengths, [prior.base_length, prior.connector_length or 4e-3][:stiff])
    return Unknowns(start, spread, low, high, scale=spread)


def lengths_at_their_end(prior: Limb, found: Limb) -> str:
    """Return a sentence where the lengths of segments went as far as they may; else empty."""
    found_lengths = lengths_of(found)
    at_end = _known(prior).at_bound(found_lengths)
    ends = [
        f"segment {index} is given as {1e3 * given.length:.0f} mm and was found to be "
        f"{1e3 * length:.0f} mm or {'less' if length < given.length else 'more'}"
        for index, (given, length) in enumerate(zip(prior.segments, found_lengths, strict=False))
        if at_end[index]
    ]
    if not ends:
        return ""
    return (
        "the limb may be unlike the model: tips do not go with even bends. Or lengths are as far "
        f"from the prior's as they may be: {', '.join(ends)}. Measure the segments and give their "
        "lengths in the limb file of --prior; check the unit and the origin of the tips"
    )


def lengths_of(limb: Limb) -> Array:
    """Return the lengths of segments, stiff base and, if there is one, connector (L,) [m]."""
    lengths = [*(s.length for s in limb.segments), limb.base_length]
    return np.array([*lengths, limb.connector_length] if limb.segment_count > 1 else lengths)


def with_lengths(limb: Limb, lengths: Array) -> Limb:
    """Return the limb with lengths (L,) [m] in the order of `lengths_of`.

    It weighs the same, and what it carries stays where it is on its segment or connector.
    """
    segments = tuple(
        replace(segment, length=float(length))
        for segment, length in zip(limb.segments, lengths[: limb.segment_count], strict=True)
    )
    base, *connector = lengths[limb.segment_count :].tolist()
    between = connector[0] if connector else limb.connector_length
    bare = replace(limb, segments=segments, base_length=base, connector_length=between, masses=())
    places = np.interp([m.arc_length for m in limb.masses], _joints(limb), _joints(bare))
    masses = (
        replace(item, arc_length=float(place))
        for item, place in zip(limb.masses, places, strict=True)
    )
    return replace(bare, masses=tuple(masses)).weighing(limb.mass)


def _even_tip(limb: Limb, angles: Array) -> Array:
    """Return the tips (K, 2) of the planners' rod, bent evenly by angles (K, M) [m]."""
    return RodModel(limb).kinematics.tip(angles)


def _joints(limb: Limb) -> Array:
    """Return the arc lengths of the clamp and of the ends of base, segments and connectors [m]."""
    pieces = [0.0, limb.base_length]
    for index, segment in enumerate(limb.segments):
        pieces += [limb.connector_length if index else 0.0, segment.length]
    return np.cumsum(pieces)
