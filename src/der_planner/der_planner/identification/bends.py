"""Bend angles and tips along a log, predicted open loop, by what a fit may change.

Friction and creep act along the bend at rest that the pressures give, as when the limb is predicted
afterwards; along the measured bend, an error of friction would partly cancel itself in the
residual. Only while a segment waits for pressures to change does the measured swing count: it lets
go of what friction held, which would pass for creep and for a spring that softens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, lru_cache, partial
from itertools import compress

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
from der_planner.model.model import Rollout

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
_OF_THE_SWING = {"damping", "material_damping", "swing_inertia"}
"""Parameters of a segment that change neither how it rests nor what drives it."""
_OF_THE_BODY = {"length", "bending_stiffness", "mass_per_length"} | _OF_THE_SWING
"""Parameters of a segment that change the body which moves, not only what drives it."""


def follow(model: Model, log: Prepared, *, linearise: bool = False) -> Response:
    """Return what a model does under the pressures of a log, friction loosened by its swings.

    Raises:
        RuntimeError: it cannot follow, or does not come to rest.
    """
    time = log.log.time
    bend = _rubs_along(model.material.resting_bend(time, log.pressure), log)
    return simulate(model, time, pressures=log.pressure, bend=lambda _: bend, linearise=linearise)


class Predicted:
    """What a limb does along a log of K rows, and the derivatives by P unknowns where asked for.

    Args:
        free: the unknowns.
        model: of any limb; says what bends.
        log: prepared.
        values: (P,) of the unknowns.

    Raises:
        RuntimeError: the model cannot follow.

    Attributes:
        angles: (K, M) bend angles [rad].
        tip: (K, 2) [m].
    """

    def __init__(self, free: FreeTerms, model: Model, log: Prepared, values: Array) -> None:
        self._free, self._log, self._values = free, log, values
        self._limb = free.limb_with(values)
        steps = _NUDGE * np.diag(free.unknowns.scale)
        self._nudged = [free.limb_with(values + step) for step in steps]
        self._driven = [not self._changed(nudged) & _OF_THE_BODY for nudged in self._nudged]
        self._model = model.another(self._limb)
        self._response = follow(self._model, log, linearise=any(self._driven))
        self.angles, self.tip = self._response.bend_angles, self._response.tip

    @cached_property
    def by(self) -> tuple[Array, Array]:
        """The derivatives (K, M, P) of the bend angles, and (K, 2, P) of the tip.

        What drives the limb goes through the model's exact tangent; stiffness, damping and mass,
        which change what bends, are differences of two simulations.
        """
        parts, count, scale = (self.angles, self.tip), len(self._values), self._free.unknowns.scale
        angles_by, tip_by = (np.empty((*part.shape, count)) for part in parts)
        if self._response.derivative is not None:
            driven = np.array(self._driven)
            nudged = list(compress(self._nudged, driven))
            change = _moments_change(self._limb, nudged, self._log, self.angles)
            gain = np.array([segment.moment_gain for segment in self._limb.segments])
            change /= gain[:, None] * _NUDGE * scale[driven]
            moved = self._response.derivative.by_effective(change)
            tip_by[:, :, driven], angles_by[:, :, driven] = moved
        moving = np.flatnonzero(np.logical_not(self._driven))
        with ThreadPoolExecutor() as threads:  # the kernels hold no lock
            found = threads.map(self._difference, moving)
            for place, (angles, tip) in zip(moving, found, strict=True):
                angles_by[:, :, place], tip_by[:, :, place] = angles, tip
        return angles_by, tip_by

    def _difference(self, place: int) -> tuple[Array, Array]:
        """Return the derivatives (K, M) and (K, 2) by one unknown, from another simulation."""
        step = np.zeros(len(self._values))
        step[place] = _STEP * self._free.unknowns.scale[place]
        try:
            other = self._at(step)
        except RuntimeError:  # beyond what the model can follow
            step = -step
            other = self._at(step)
        change = step[place]
        return (other.bend_angles - self.angles) / change, (other.tip - self.tip) / change

    def _at(self, step: Array) -> Response | Rollout:
        limb, response = self._free.limb_with(self._values + step), self._response
        model = self._model.another(limb)
        if self._changed(limb) <= _OF_THE_SWING:
            return model.run(response.begin, response.effective_pressure, CONTROL_PERIOD)
        return follow(model, self._log)

    def _changed(self, other: Limb) -> set[str]:
        """Return the parameters of segments in which another limb differs."""
        pairs = zip(self._limb.segments, other.segments, strict=True)
        return {key for a, b in pairs for key in vars(a) if getattr(a, key) != getattr(b, key)}


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
        self.free, self._logs, self.more_rows = free, logs, more_rows
        # A search comes back to its best values after steps that led to nothing better. What is
        # kept must not know this fit: the two would hold each other, and 200 MB, in memory.
        self._kept = lru_cache(maxsize=3)(partial(_predict, free, model, logs))
        self._bends_on = [_bends_on(free.limb, log) for log in logs]
        self._shaken = [_shaken(free.limb, log) for log in logs]
        self.weigh(np.full((3, free.limb.segment_count), ANGLE_ERROR))
        self._weighed = False

    def weigh(self, errors: Array) -> None:
        """Take errors (3, M) of bend angles for granted, see `LEAST_ERRORS` [rad]."""
        self.errors = np.maximum(errors, 1e-3 * ANGLE_ERROR)
        self.errors[2] = np.maximum(errors[2], SHAKEN_WORSE * errors[0])
        self._weighed = True

    @property
    def search(self) -> LeastSquares:
        """The search for the unknowns by the weights of now."""
        return LeastSquares(self.free.unknowns, self._rows, SOFTNESS / np.sqrt(CORRELATION))

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
        """Return what is predicted along the logs.

        Raises:
            RuntimeError: the model cannot follow the logs.
        """
        return self._kept(same_values(values, self.free.unknowns))

    def _rows(self, values: Array) -> Rows | None:
        try:
            found = self._predicted(values)
        except RuntimeError:  # also where arcs that buckle do not come to rest
            return None
        logs, places = self._logs, range(len(self._logs))
        more = [] if self.more_rows is None else [self.more_rows(found[0])]
        errors = [
            self._apart_and_weighed(k, found[k].angles - logs[k].log.bend_angles) for k in places
        ]

        def slopes() -> Array:
            by = [self._apart_and_weighed(k, found[k].by[0]) for k in places]
            return np.concatenate([*by, *(derivatives() for _, derivatives in more)])

        return np.concatenate([*errors, *(residual for residual, _ in more)]), slopes

    def _apart_and_weighed(self, place: int, table: Array) -> Array:
        """Return the usable rows of a log's table (K, M, …), slow and fast parts, by weight."""
        rows = self._logs[place].usable
        on, shaken = self._bends_on[place][rows], self._shaken[place][rows]
        usual = np.repeat(self.errors[:2, None], rows.sum(), axis=1)
        usual[1, ~on] = self.errors[0]  # elsewhere fast errors count as slow ones do
        usual[0, shaken] = self.errors[2]
        usual[1, shaken & ~on] = self.errors[2]
        weight = 1.0 / (usual * np.sqrt(CORRELATION))
        parts = np.stack(_apart(table[rows]))
        weighed = weight.reshape(*weight.shape, *[1] * (table.ndim - 2)) * parts
        return np.asarray(weighed.reshape(-1, *table.shape[2:]))

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
            slopes = part.by[0][log.usable].reshape(-1, len(values)) * unknowns.scale
            columns.append(np.column_stack([-speed[log.usable].ravel(), slopes]))
            errors.append((log.log.bend_angles - part.angles)[log.usable].ravel())
        weight = 1.0 / (ANGLE_ERROR * np.sqrt(CORRELATION * self.excess(self.remaining(values))))
        table, error = weight * np.concatenate(columns), weight * np.concatenate(errors)
        known = np.where(unknowns.known, unknowns.scale / unknowns.spread, 0.0)
        information = table.T @ table + np.diag(np.append(0.0, known**2))
        covariance = np.linalg.pinv(information, hermitian=True)
        return float(covariance[0] @ table.T @ error), float(np.sqrt(covariance[0, 0]))


def _predict(
    free: FreeTerms, model: Model, logs: Sequence[Prepared], key: bytes
) -> list[Predicted]:
    """Return what is predicted along logs at the values that `same_values` has named."""
    values = np.frombuffer(key) * free.unknowns.scale
    return [Predicted(free, model, log, values) for log in logs]


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
