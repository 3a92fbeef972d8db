"""Bend angles and tips along a log, predicted open loop, by what a fit may change.

Friction and creep act along the bend at rest that the pressures give, as when the limb is predicted
afterwards; along the measured bend, an error of friction would partly cancel itself in the
residual. Only while a segment waits for pressures to change does the measured swing count: it lets
go of what friction held, which would pass for creep and for a spring that softens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter1d, uniform_filter1d

from der_planner.arrays import Array
from der_planner.identification.least_squares import (
    TOLERANCE,
    LeastSquares,
    Rows,
    correlation_length,
    same_values,
)
from der_planner.identification.log import Prepared
from der_planner.identification.terms import FreeTerms
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, Material, Model, Response, simulate

NODES = 13
"""Nodes of the rod in a fit. Its statics do not depend on them, its first two natural frequencies
change by 2 %."""
ANGLE_ERROR = np.deg2rad(0.3)
"""Error of a predicted bend angle that is taken for granted before its residual is known [rad]."""
CORRELATION = 20.0
"""Rows over which an error of the model stays the same (1 s), and which part slow from fast."""
LEAST_ERRORS = np.array([[ANGLE_ERROR], [np.deg2rad(0.1)], [ANGLE_ERROR]])
"""Least errors (3, 1) for which bend angles are weighed: slow, fast ones, and slow ones of a limb
that was shaken; of any model, and of tags [rad]."""
BENDS_ON = np.deg2rad(2.0)
"""Rate of the bend that pressures ask for from which on friction does not turn round [rad/s]."""
SHAKES = 0.5
"""The same rate from which on a limb swings so much that what its friction held lets go [rad/s]."""
SHAKEN = 4.0
"""Time for which that is so afterwards [s]."""
SHAKEN_WORSE = 8.0
"""Slow errors then over those elsewhere, at least."""
WAITS = 5
"""Rows between those in which pressures drive a segment and those in which it swings alone."""
SWING_SMOOTHED = 2.0
"""Standard deviation of the smoothing of measured swings: noise would let go of friction [rows]."""
SOFTNESS = 3.0
"""Errors beyond this multiple of the usual one count less than their square."""
ROUGH = 3e-2
"""Relative change of the sum of squares at which a search ends whose weights are not known yet."""
SAME_WEIGHT = math.log(1.1)
"""Change of the logarithm of an error up to which a search need not be repeated."""
MOST_FITS = 3
"""Largest number of searches with weights that an earlier one told."""
_NUDGE = 1e-3
"""Change of an unknown, in units of its scale, for the slope of the effective pressure."""
_STEP = 0.1
"""Change of an unknown, in units of its scale, for the difference of two simulations."""
_OF_THE_BODY = (
    *("length", "bending_stiffness", "mass_per_length"),
    *("damping", "material_damping", "swing_inertia"),
)
"""Parameters of a segment that change the body which moves, not only what drives it."""


class Predicted(NamedTuple):
    """What a limb does along a log of K rows, and the derivatives by P unknowns.

    Attributes:
        angles: (K, M) bend angles [rad].
        tip: (K, 2) [m].
        angles_by: (K, M, P).
        tip_by: (K, 2, P).
    """

    angles: Array
    tip: Array
    angles_by: Array
    tip_by: Array


def follow(model: Model, log: Prepared, *, linearise: bool = False) -> Response:
    """Return what a model does under the pressures of a log, friction loosened by its swings.

    Raises:
        RuntimeError: it cannot follow, or does not come to rest.
    """
    time = log.log.time
    bend = _rubs_along(model.material.resting_bend(time, log.pressure), log)
    return simulate(
        model, time, pressures=log.pressure, bend=lambda _: bend, steps=1, linearise=linearise
    )


def predicted(free: FreeTerms, model: Model, log: Prepared, values: Array) -> Predicted:
    """Return bend angles and tips along a log with their derivatives by P unknowns.

    What drives the limb goes through the model's exact tangent; stiffness, damping and mass, which
    change what bends, are differences of two simulations.

    Args:
        free: the unknowns.
        model: of any limb; says what bends.
        log: prepared.
        values: (P,) of the unknowns.

    Raises:
        RuntimeError: the model cannot follow.
    """
    limb, scale = free.limb_with(values), free.unknowns.scale
    units = np.diag(scale)
    limbs = [free.limb_with(values + _NUDGE * unit) for unit in units]
    driven = [_same_body(limb, nudged) for nudged in limbs]
    # The tangent of the arcs takes longer than all their differences: only where it is needed.
    response = follow(model.another(limb), log, linearise=any(driven))
    angles, tip = response.bend_angles, response.tip
    angles_by, tip_by = (np.empty((*part.shape, len(values))) for part in (angles, tip))
    if response.derivative is not None:
        change = _moments_change(limb, list(compress(limbs, driven)), log, angles)
        gain = np.array([segment.moment_gain for segment in limb.segments])
        change /= gain[:, None] * _NUDGE * scale[driven]
        tip_by[:, :, driven], angles_by[:, :, driven] = response.derivative.by_effective(change)
    for place in np.flatnonzero(np.logical_not(driven)):
        moved = follow(model.another(free.limb_with(values + _STEP * units[place])), log)
        tip_by[:, :, place] = (moved.tip - tip) / (_STEP * scale[place])
        angles_by[:, :, place] = (moved.bend_angles - angles) / (_STEP * scale[place])
    return Predicted(angles, tip, angles_by, tip_by)


def _same_body(limb: Limb, other: Limb) -> bool:
    pairs = zip(limb.segments, other.segments, strict=True)
    return all(getattr(a, key) == getattr(b, key) for a, b in pairs for key in _OF_THE_BODY)


def _moments_change(limb: Limb, nudged: list[Limb], log: Prepared, angles: Array) -> Array:
    """Return the changes (K, M, P) of `_moments` by P limbs that differ a little [N·m]."""
    time, pressure, material = log.log.time, log.pressure, Material(limb)
    rest = material.resting_bend(time, pressure)
    before = material.driven_bend(time, pressure, rest)
    driven = [Material(each).driven_bend(time, pressure, rest) - before for each in nudged]
    moved = material.resting_bend_change(time, pressure, rest, np.stack(driven, axis=2))
    moments = [
        _moments(each, log, angles, _rubs_along(rest + moved[..., place], log))
        for place, each in enumerate(nudged)
    ]
    here = _moments(limb, log, angles, _rubs_along(rest, log))
    change: Array = np.stack(moments, axis=2) - here[..., None]
    return change


def _moments(limb: Limb, log: Prepared, angles: Array, along: Array) -> Array:
    """Return the moments (K, M) that drive the limb, less the elastic ones of its bend [N·m].

    Friction and creep act along another bend (K, M) [rad].
    """
    material = Material(limb)
    beside = material.driven_bend(log.log.time, log.pressure, angles, along)
    moments: Array = material.resting_law.stiffness * beside
    return moments


class BendFit:
    """A fit of a limb's unknowns to the bend angles of logs, by any model.

    Args:
        free: the unknowns.
        model: of any limb; says what bends.
        logs: prepared; one or more of the same limb.
        more_rows: further weighted rows of what is predicted along the first log, with their
            derivatives; None: the bend angles alone.
    """

    def __init__(
        self,
        free: FreeTerms,
        model: Model,
        logs: Sequence[Prepared],
        more_rows: Callable[[Predicted], Rows] | None = None,
    ) -> None:
        self.free, self._model, self._logs, self._more_rows = free, model, logs, more_rows
        self._last: tuple[bytes, list[Predicted]] = (b"", [])
        self._bends_on = [_bends_on(free.limb, log) for log in logs]
        self._shaken = [_shaken(free.limb, log) for log in logs]
        self.weigh(np.full((3, free.limb.segment_count), ANGLE_ERROR))
        self._weighed = False

    def weigh(self, errors: Array) -> None:
        """Take errors (3, M) of bend angles for granted, see `LEAST_ERRORS` [rad]."""
        self.errors = np.maximum(errors, 1e-3 * ANGLE_ERROR)
        self.errors[2] = np.maximum(errors[2], SHAKEN_WORSE * errors[0])
        self._weighed = True
        unknowns = self.free.unknowns
        self.search = LeastSquares(unknowns, self._rows, SOFTNESS / np.sqrt(CORRELATION))

    def solve(self, start: Array, most: int = MOST_FITS) -> Array:
        """Return the best values (P,), the bend angles weighed by the errors that these leave.

        With the errors taken for granted, a log that the model cannot explain would outweigh
        everything that is known before it, and move what it does not tell. Errors that were
        weighed before, as another fit to the log left them, save the rough search.

        Args:
            start: (P,) that the model follows.
            most: number of searches with weights that an earlier one told.

        Raises:
            ValueError: the model cannot be followed at the start.
        """
        values = start
        for _ in range(most if self._weighed else 1 + most):
            values = self.search.solve(values, TOLERANCE if self._weighed else ROUGH)
            before, known = self.errors, self._weighed
            self.weigh(np.maximum(self.errors_left(values), LEAST_ERRORS))
            if known and np.abs(np.log(self.errors / before)).max() < SAME_WEIGHT:
                break
        return values

    def _predicted(self, values: Array) -> list[Predicted]:
        """Return what is predicted along the logs; the last one is kept.

        Raises:
            RuntimeError: the model cannot follow the logs.
        """
        key = same_values(values, self.free.unknowns)
        if self._last[0] != key:
            found = [predicted(self.free, self._model, log, values) for log in self._logs]
            self._last = (key, found)
        return self._last[1]

    def _rows(self, values: Array) -> Rows | None:
        try:
            found = self._predicted(values)
        except RuntimeError:  # also where arcs that buckle do not come to rest
            return None
        errors, slopes, scale = [], [], np.sqrt(CORRELATION)
        masks = zip(self._logs, found, self._bends_on, self._shaken, strict=True)
        for log, part, on, shaken in masks:
            rows = log.usable
            left = _apart(part.angles[rows] - log.log.bend_angles[rows])
            by = _apart(part.angles_by[rows])
            usual = np.repeat(self.errors[:2, None], rows.sum(), axis=1)
            usual[1, ~on[rows]] = self.errors[0]  # elsewhere fast errors count as slow ones do
            usual[0, shaken[rows]] = self.errors[2]
            usual[1, shaken[rows] & ~on[rows]] = self.errors[2]
            for error, change, weight in zip(left, by, 1.0 / (usual * scale), strict=True):
                errors.append((weight * error).ravel())
                slopes.append((weight[..., None] * change).reshape(-1, len(values)))
        if self._more_rows is not None:
            more = self._more_rows(found[0])
            errors.append(more[0])
            slopes.append(more[1])
        return np.concatenate(errors), np.concatenate(slopes)

    def remaining(self, values: Array) -> Array:
        """Return measured less predicted bend angles (K, M) of all logs [rad], NaN where unused.

        Raises:
            RuntimeError: the model cannot follow the logs.
        """
        pairs = zip(self._logs, self._predicted(values), strict=True)
        return np.concatenate(
            [
                np.where(log.usable[:, None], log.log.bend_angles - part.angles, np.nan)
                for log, part in pairs
            ]
        )

    def errors_left(self, values: Array) -> Array:
        """Return the errors (3, M) [rad] that values (P,) leave, see `LEAST_ERRORS`.

        Slow ones are as large as errors that stay the same for `CORRELATION` rows would have to be.
        """
        remaining = self.remaining(values)
        usable = np.concatenate([log.usable for log in self._logs])
        slow, fast = _apart(remaining[usable])
        fast = fast[np.concatenate(self._bends_on)[usable]]
        # Each fitted unknown uses up some of what is independent (degrees of freedom).
        length = correlation_length(slow)
        independent = slow.size / max(length, CORRELATION)
        left = max(independent - len(self.free.unknowns.prior), 0.5 * independent)
        longer = max(length / CORRELATION, 1.0) * independent / left
        shaken = np.concatenate(self._shaken)[usable]
        parts = [longer * slow[~shaken] ** 2, fast**2, longer * slow[shaken] ** 2]
        return np.sqrt([part.sum(axis=0) / max(len(part), 1) for part in parts])

    def excess(self, remaining: Array) -> float:
        """Return by how much the data's variance exceeds that of `ANGLE_ERROR` and `CORRELATION`.

        Args:
            remaining: (K, M) of the values that were found [rad].
        """
        error = float(np.sqrt(np.nanmean(remaining**2)))
        # Errors of neighbouring rows are correlated: rows / correlation length are independent.
        length = correlation_length(remaining)
        independent = np.count_nonzero(np.isfinite(remaining)) / length
        # Each fitted unknown uses up one of them (degrees of freedom).
        left = max(independent - len(self.free.unknowns.prior), 0.2 * independent)
        return float((error / ANGLE_ERROR) ** 2 * length / CORRELATION * independent / left)

    def delay(self, values: Array) -> tuple[float, float]:
        """Return by how long what was seen is late, and its standard deviation [s].

        A limb that is seen late by d shows θ(t − d) ≈ θ − d θ̇. That is one more column beside those
        of the unknowns, which may take up a part of it: the two are solved for together. What a
        pressure needs from its sensor to the limb is in it, too.

        Args:
            values: (P,) as found.

        Raises:
            RuntimeError: the model cannot follow the logs.
        """
        unknowns = self.free.unknowns
        columns, errors = [], []
        for log, part in zip(self._logs, self._predicted(values), strict=True):
            speed = np.gradient(part.angles, log.log.time, axis=0)
            slopes = part.angles_by[log.usable].reshape(-1, len(values)) * unknowns.scale
            columns.append(np.column_stack([-speed[log.usable].ravel(), slopes]))
            errors.append((log.log.bend_angles - part.angles)[log.usable].ravel())
        weight = 1.0 / (ANGLE_ERROR * np.sqrt(CORRELATION * self.excess(self.remaining(values))))
        table, error = weight * np.concatenate(columns), weight * np.concatenate(errors)
        known = np.where(unknowns.known, unknowns.scale / unknowns.spread, 0.0)
        information = table.T @ table + np.diag(np.append(0.0, known**2))
        covariance = np.linalg.pinv(information, hermitian=True)
        return float(covariance[0] @ table.T @ error), float(np.sqrt(covariance[0, 0]))


def _apart(table: Array) -> tuple[Array, Array]:
    """Return the slow part of a table (K, …), its mean over `CORRELATION` rows, and the rest.

    Friction that turns round in a swing is taken for stiffness or damping. While all segments bend
    on it stays the same, and what is fast is the swing of the body.
    """
    slow: Array = uniform_filter1d(table, round(CORRELATION), axis=0, mode="nearest")
    return slow, table - slow


def _rubs_along(rest: Array, log: Prepared) -> Array:
    """Return the bend angles (K, M) along which friction and creep act in a log, see the module.

    Args:
        rest: (K, M) of the model at rest [rad].
        log: prepared.
    """
    if not log.swings:
        return rest
    _, swing = _apart(gaussian_filter1d(log.bend, SWING_SMOOTHED, axis=0, mode="nearest"))
    waits = np.abs(np.gradient(rest, CONTROL_PERIOD, axis=0)) < BENDS_ON
    waits = binary_erosion(waits, np.ones((2 * WAITS + 1, 1), dtype=bool))
    along: Array = rest + waits * (swing - _apart(rest)[1])
    return along


def _bends_on(limb: Limb, log: Prepared) -> NDArray[np.bool_]:
    """Return the rows (K,) around which the pressures bend all segments on, each in one way."""
    rate = _bend_rate(limb, log, round(CORRELATION))
    on = log.usable & np.all(np.abs(rate) > BENDS_ON, axis=1)
    return np.asarray(binary_erosion(on, iterations=round(CORRELATION / 2)))


def _shaken(limb: Limb, log: Prepared) -> NDArray[np.bool_]:
    """Return the rows (K,) in which friction holds less than a model without swing says."""
    jumps = np.any(np.abs(_bend_rate(limb, log, 5)) > SHAKES, axis=1)
    return np.convolve(jumps, np.ones(round(SHAKEN / CONTROL_PERIOD)))[: len(jumps)] > 0.5


def _bend_rate(limb: Limb, log: Prepared, rows: int) -> Array:
    """Return the rate (K, M) of the bend that the pressures ask for, over some rows [rad/s]."""
    pressure = uniform_filter1d(log.pressure, rows, axis=0, mode="nearest")
    return limb.static_gain * np.gradient(pressure, CONTROL_PERIOD, axis=0)
