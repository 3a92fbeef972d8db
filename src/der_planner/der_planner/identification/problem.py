"""Nonlinear least squares of a log's bend angles, with priors, on the rod's exact derivatives."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.geometry import UnevenTips
from der_planner.identification.logs.log import LogError
from der_planner.identification.logs.prepare import Prepared
from der_planner.identification.parameters import (
    TERMS,
    column,
    exists,
    put,
    start_values,
    without,
)
from der_planner.identification.report import Unknown
from der_planner.identification.rod_angles import Predicted, RodAngles
from der_planner.identification.statics import static_start
from der_planner.limb import Limb
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]

ANGLE_ERROR = np.deg2rad(0.3)
"""Error of a predicted bend angle that is taken for granted [rad]; the residual replaces it."""
CORRELATION = 20.0
"""Rows over which an error of the model stays the same (1 s)."""
MOST_EVALUATIONS = 25
"""Evaluations of model and derivatives in a fit. Unknowns that still change after so many change by
less than their uncertainty."""
UNTOLD = 0.8
"""An unknown whose spread is still more than this share of its prior spread was not shown by the
log."""
NOT_FOLLOWED = np.pi
"""Error that every row is given where the rod cannot follow a trial of the optimiser [rad]."""
STIFFER_STARTS = (0.0, 0.25, 0.5, 0.9)
"""Added to the logarithm of the stiffness, or taken off that of the mass, until the rod can follow
the log from there."""


class Problem:
    """The unknowns of one limb and one log.

    Args:
        limb: geometry, masses, gravity and everything that is not an unknown.
        prepared: the log.
        offset: (M,) of the pressure sensors [Pa].
        groups: of terms to fit.
        nodes: of the rod.
        start: (M, T) values to start from; None: in closed form from the log's statics.
        tips: fit to them, too; None: to the bend angles alone.
    """

    def __init__(
        self,
        limb: Limb,
        prepared: Prepared,
        offset: Array,
        groups: frozenset[str],
        nodes: int,
        start: Array | None = None,
        tips: UnevenTips | None = None,
    ) -> None:
        self.groups, self.nodes, self._tips = groups, nodes, tips
        self._prepared = prepared
        self._wanted = [
            (segment, index)
            for segment in range(limb.segment_count)
            for index, term in enumerate(TERMS)
            if (term.group == "linear" or term.group in groups)
            and exists(segment, index, limb.segment_count)
            and not (term.name == "log_stiffness" and "mass" in groups)
            # Without weight, or with an unknown mass, it is one scale with the stiffness.
            and not (term.name == "log_inertia" and ("mass" in groups or not any(limb.gravity[:2])))
        ]
        self._scale = np.array([TERMS[index].scale for _, index in self._wanted])
        self._spread = np.array([TERMS[index].spread for _, index in self._wanted])
        self._known = np.isfinite(self._spread)
        self._prediction = RodAngles(limb, prepared.log.time, prepared.pressure - offset, nodes)
        self._prior = without(start_values(limb), groups)
        self._start = self._static_start(limb, offset) if start is None else start.copy()
        self._weight = 1.0 / (ANGLE_ERROR * np.sqrt(CORRELATION))
        self._cache: tuple[bytes, Predicted | None] | None = None
        self.evaluations = 0

    def solve(self) -> tuple[Array, Array]:
        """Return the unknowns (M, T) and the Jacobian of the weighted residual.

        A trial that the rod cannot follow is given the error `NOT_FOLLOWED` in every row, so that
        the optimiser goes back and takes a shorter step.

        Raises:
            LogError: the rod cannot follow the log from any of the starts.
        """
        low = np.array([TERMS[index].low for _, index in self._wanted]) / self._scale
        high = np.array([TERMS[index].high for _, index in self._wanted]) / self._scale
        margin = 1e-6 * (high - low)
        self._start_where_the_rod_follows(low + margin, high - margin)
        solution = least_squares(
            self._residual,
            np.clip(self._scaled(self._start), low + margin, high - margin),
            jac=self._jacobian,
            bounds=(low, high),
            loss="soft_l1",
            f_scale=3.0 / np.sqrt(CORRELATION),
            xtol=1e-3,
            ftol=1e-4,
            max_nfev=MOST_EVALUATIONS,
            x_scale="jac",
        )
        values = self._values(solution.x)
        return values, self._jacobian(solution.x)

    def remaining(self, values: Array) -> Array:
        """Return measured less predicted bend angles (K, M) [rad], NaN where unmeasured."""
        return self._prepared.log.bend_angles - self._prediction.angles(values)

    def uncertainties(self, values: Array, jacobian: Array) -> tuple[tuple[Unknown, ...], Array]:
        """Return the unknowns with standard deviations, and their correlation (P, P)."""
        remaining = self.remaining(values)
        error = float(np.sqrt(np.nanmean(remaining**2)))
        # Errors of neighbouring rows are correlated: rows / correlation length are independent.
        length = correlation_length(remaining)
        factor = (error / ANGLE_ERROR) ** 2 * length / CORRELATION
        # Each fitted unknown uses up one of them (degrees of freedom).
        independent = np.count_nonzero(np.isfinite(remaining)) / length
        factor *= independent / max(independent - len(self._wanted), 0.2 * independent)
        data = jacobian[: -int(self._known.sum()) or None]
        information = data.T @ data / max(factor, 1e-6)
        prior = np.where(self._known, self._scale / self._spread, 0.0)
        covariance = np.linalg.pinv(information + np.diag(prior**2))
        deviation = np.sqrt(np.diag(covariance))
        correlation = covariance / np.outer(deviation, deviation)
        unknowns = []
        for place, (segment, index) in enumerate(self._wanted):
            term = TERMS[index]
            sigma = float(deviation[place] * term.scale)
            value = float(values[segment, index])
            edge = min(value - term.low, term.high - value) < 1e-3 * (term.high - term.low)
            unknowns.append(
                Unknown(
                    name=term.name if term.shared else f"{term.name}[{segment}]",
                    unit=term.unit,
                    value=value,
                    deviation=sigma,
                    untold=bool(sigma > UNTOLD * term.spread),
                    at_bound=bool(edge),
                )
            )
        return tuple(unknowns), correlation

    def _static_start(self, limb: Limb, offset: Array) -> Array:
        rows = self._prepared.usable
        found = static_start(
            limb, (self._prepared.pressure - offset)[rows], self._prepared.bend[rows]
        )
        values = self._prior.copy()
        gain = TERMS[column("gain")]
        values[:, column("gain")] = np.clip(found.gain, 1.1 * gain.low, 0.9 * gain.high)
        values[:, column("rest_angle")] = np.clip(found.rest, -0.5, 0.5)
        if (0, column("log_stiffness")) in self._wanted:
            values[:, column("log_stiffness")] = found.log_stiffness
        return values

    def _start_where_the_rod_follows(self, low: Array, high: Array) -> None:
        """Begin stiffer (or lighter) if the rod cannot follow the log with the first guess."""
        begin = self._start.copy()
        name, sign = ("log_mass", -1.0) if "mass" in self.groups else ("log_stiffness", 1.0)
        fitted = (0, column(name)) in self._wanted
        for more in STIFFER_STARTS if fitted else STIFFER_STARTS[:1]:
            self._start = begin.copy()
            self._start[:, column(name)] += sign * more
            if self._evaluate(np.clip(self._scaled(self._start), low, high)) is not None:
                return
        raise LogError(
            "the rod cannot follow this log, neither with the prior's stiffness nor with more: "
            "check the prior's gravity, mass, masses and lengths, and that x points along the "
            "straight limb"
        )

    def _values(self, x: Array) -> Array:
        values = self._start.copy()
        for (segment, index), value in zip(self._wanted, x * self._scale, strict=True):
            put(values, segment, index, float(value))
        return values

    def _scaled(self, values: Array) -> Array:
        wanted = np.array([values[place] for place in self._wanted])
        return np.asarray(wanted / self._scale)

    def _evaluate(self, x: Array) -> Predicted | None:
        """Return the prediction with its derivatives; None: the rod cannot follow."""
        key = x.tobytes()
        if self._cache is None or self._cache[0] != key:
            self.evaluations += 1
            found: Predicted | None
            try:
                found = self._prediction.derivatives(self._values(x), self._wanted)
            except ConvergenceError:
                found = None
            if found is not None and not np.all(np.isfinite(found.angles)):
                found = None
            self._cache = (key, found)
        return self._cache[1]

    def _residual(self, x: Array) -> Array:
        found = self._evaluate(x)
        rows = self._prepared.usable
        measured = self._prepared.log.bend_angles[rows]
        error = np.full(measured.shape, NOT_FOLLOWED)
        if found is not None:
            error = found.angles[rows] - measured
        parts = [self._weight * error.ravel()]
        if self._tips is not None:
            parts.append(self._tips.residual(found))
        prior = ((x - self._scaled(self._prior)) * self._scale / self._spread)[self._known]
        return np.concatenate([*parts, prior])

    def _jacobian(self, x: Array) -> Array:
        found = self._evaluate(x)
        assert found is not None  # a trial that is not followed is never where the optimiser stays
        rows = self._prepared.usable
        parts = [self._weight * found.angles_by[rows].reshape(-1, len(x)) * self._scale]
        if self._tips is not None:
            parts.append(self._tips.jacobian(found) * self._scale)
        prior = np.diag(self._scale / self._spread)[self._known]
        return np.concatenate([*parts, prior])


def correlation_length(remaining: Array) -> float:
    """Return over how many rows the errors (K, M) of a prediction stay alike, 1 or more.

    One plus twice the sum of the autocorrelation up to its first zero, at most a third of the log;
    the larger of the columns.
    """
    lengths, longest = [1.0], len(remaining) // 3
    for error in remaining.T:
        known = error[np.isfinite(error)]
        known = known - known.mean()
        power = float(known @ known)
        if power == 0 or known.size < 2:
            continue
        total = 1.0
        for lag in range(1, min(longest, known.size - 1)):
            value = float(known[lag:] @ known[:-lag]) / power
            if value <= 0:
                break
            total += 2.0 * value
        lengths.append(total)
    return max(lengths)
