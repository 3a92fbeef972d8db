"""From a log to a limb: air, lengths, statics, then everything at once on the rod's dynamics."""

from __future__ import annotations

import datetime
import time as clock
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.air import AirFit, fit_air
from der_planner.identification.geometry import GeometryFit, fit_geometry, with_geometry
from der_planner.identification.log import CalibrationLog, LogError
from der_planner.identification.parameters import (
    GROUPS,
    TERMS,
    column,
    exists,
    put,
    start_values,
    to_limb,
    without,
)
from der_planner.identification.pcc_fit import fit_pcc
from der_planner.identification.prepare import LONGEST_GAP, Prepared, prepare
from der_planner.identification.report import FitReport, Unknown
from der_planner.identification.rod_angles import NODES, RodAngles
from der_planner.identification.statics import static_gain
from der_planner.limb import CalibratedRange, Limb
from der_planner.model.series import CONTROL_PERIOD

Array = NDArray[np.float64]

ANGLE_ERROR = np.deg2rad(0.3)
"""Error of a predicted bend angle that is taken for granted [rad]; the residual replaces it."""
CORRELATION = 20.0
"""Rows over which an error of the model stays the same (1 s)."""
MOST_EVALUATIONS = 25
"""Of model and derivatives; what still moves by then moves less than its uncertainty."""
STRONG = 0.9
"""|correlation| above which two unknowns are reported as a pair that the log cannot tell apart."""
UNTOLD = 0.8
"""Share of its prior spread that must be left of an unknown that the data say nothing about."""


def fit(
    limb: Limb,
    log: CalibrationLog,
    *,
    terms: Iterable[str] = GROUPS,
    geometry: bool = True,
    nodes: int = NODES,
    longest_gap: float = LONGEST_GAP,
) -> tuple[Limb, FitReport]:
    """Identify a limb from a calibration run.

    Args:
        limb: geometry, masses, limits and first guesses; mass and axial stiffness are kept.
        log: of a calibration run, or of any run that excites every input.
        terms: model terms to fit beside gain and rest angle, of `GROUPS`.
        geometry: fit the lengths to the tips as well.
        nodes: of the rod in the fit.
        longest_gap: between two rows of the log that a straight line may bridge [s].

    Returns:
        The identified limb, with provenance and calibrated ranges, and what the data say of it.

    Raises:
        LogError: the log cannot tell the limb; the message names what is missing.
    """
    begin = clock.perf_counter()
    groups = frozenset(terms)
    if not groups <= set(GROUPS):
        raise LogError(f"unknown model term {sorted(groups - set(GROUPS))}: choose {GROUPS}")
    prepared = prepare(log, limb, longest_gap=longest_gap)
    warnings = list(prepared.warnings)
    air = _try_air(prepared, warnings)
    lengths = fit_geometry(limb, prepared.log) if geometry else None
    if lengths is not None:
        limb = with_geometry(limb, lengths.lengths, lengths.connector, lengths.base)
    offset = np.zeros(limb.segment_count) if air is None else air.offset
    problem = _Problem(limb, prepared, offset, groups, nodes)
    values, jacobian = problem.solve()
    unknowns, correlation = problem.uncertainties(values, jacobian)
    if "dynamics" in groups and all(u.untold for u in unknowns if u.name.startswith("log_stiff")):
        warnings.append(
            "the log is too slow to tell the stiffness apart from the gain: stiffness and "
            "damping keep "
            "their old values; steps or a sweep would tell them"
        )
        problem = _Problem(limb, prepared, offset, groups - {"dynamics"}, nodes)
        values, jacobian = problem.solve()
        unknowns, correlation = problem.uncertainties(values, jacobian)
    remaining = problem.remaining(values)
    found = _finish(limb, to_limb(limb, values), air, prepared, remaining)
    pcc_residual = np.full(limb.segment_count, np.nan)
    if "dynamics" in problem.groups:
        pcc_segments, pcc_residual = fit_pcc(found, prepared, offset)
        found = replace(found, pcc_segments=pcc_segments)
    report = _report(
        log, prepared, unknowns, correlation, remaining, air=air, geometry=lengths,
        pcc_residual=pcc_residual, evaluations=problem.evaluations,
        fit_time=clock.perf_counter() - begin, warnings=tuple(warnings),
    )  # fmt: skip
    return found, report


def _report(
    log: CalibrationLog,
    prepared: Prepared,
    unknowns: tuple[Unknown, ...],
    correlation: Array,
    remaining: Array,
    *,
    air: AirFit | None,
    geometry: GeometryFit | None,
    pcc_residual: Array,
    evaluations: int,
    fit_time: float,
    warnings: tuple[str, ...],
) -> FitReport:
    """Return what the data say; ``remaining`` (K, M) is measured less predicted [rad]."""
    return FitReport(
        source=log.source,
        unknowns=unknowns,
        correlation=correlation,
        strongly_correlated=_pairs(unknowns, correlation),
        untold=tuple(u.name for u in unknowns if u.untold),
        air=air,
        geometry=geometry,
        residual=np.sqrt(np.nanmean(remaining**2, axis=0)),
        largest=np.nanmax(np.abs(remaining), axis=0),
        pcc_residual=pcc_residual,
        span=np.ptp(prepared.bend[prepared.usable], axis=0),
        duration=float(prepared.log.time[-1] - prepared.log.time[0]),
        rows=int(prepared.usable.sum()),
        evaluations=evaluations,
        fit_time=fit_time,
        warnings=warnings,
    )


class _Problem:
    """Nonlinear least squares of the bend angles with priors, on the rod's exact derivatives."""

    def __init__(
        self, limb: Limb, prepared: Prepared, offset: Array, groups: frozenset[str], nodes: int
    ) -> None:
        self.groups = groups
        self._prepared = prepared
        self._wanted = [
            (segment, index)
            for segment in range(limb.segment_count)
            for index, term in enumerate(TERMS)
            if (term.group == "linear" or term.group in groups)
            and exists(segment, index, limb.segment_count)
        ]
        self._scale = np.array([TERMS[index].scale for _, index in self._wanted])
        self._spread = np.array([TERMS[index].spread for _, index in self._wanted])
        self._known = np.isfinite(self._spread)
        self._prediction = RodAngles(limb, prepared.log.time, prepared.pressure - offset, nodes)
        self._start = self._start_values(limb, prepared, offset)
        self._weight = 1.0 / (ANGLE_ERROR * np.sqrt(CORRELATION))
        self._cache: tuple[bytes, Array, Array] | None = None
        self.evaluations = 0

    def solve(self) -> tuple[Array, Array]:
        """Return the unknowns (M, T) and the Jacobian of the weighted residual."""
        low = np.array([TERMS[index].low for _, index in self._wanted]) / self._scale
        high = np.array([TERMS[index].high for _, index in self._wanted]) / self._scale
        start = np.array([self._start[place] for place in self._wanted]) / self._scale
        margin = 1e-6 * (high - low)
        solution = least_squares(
            self._residual,
            np.clip(start, low + margin, high - margin),
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
        # Neighbouring errors are alike: as many independent ones as the residual's memory leaves.
        length = correlation_length(remaining)
        factor = (error / ANGLE_ERROR) ** 2 * length / CORRELATION
        # A fit of P unknowns takes as many of them out of its residual.
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
            unknowns.append(
                Unknown(
                    name=term.name if term.shared else f"{term.name}[{segment}]",
                    unit=term.unit,
                    value=float(values[segment, index]),
                    deviation=sigma,
                    untold=bool(sigma > UNTOLD * term.spread),
                    at_bound=bool(
                        min(values[segment, index] - term.low, term.high - values[segment, index])
                        < 1e-3 * (term.high - term.low)
                    ),
                )
            )
        return tuple(unknowns), correlation

    def _start_values(self, limb: Limb, prepared: Prepared, offset: Array) -> Array:
        rows = prepared.usable
        gains, rests = static_gain((prepared.pressure - offset)[rows], prepared.bend[rows])
        values = without(start_values(limb), self.groups)
        values[:, column("gain")] = np.clip(gains, 1.1 * TERMS[0].low, 0.9 * TERMS[0].high)
        values[:, column("rest_angle")] = np.clip(rests, -0.5, 0.5)
        return values

    def _values(self, x: Array) -> Array:
        values = self._start.copy()
        for (segment, index), value in zip(self._wanted, x * self._scale, strict=True):
            put(values, segment, index, float(value))
        return values

    def _evaluate(self, x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if self._cache is None or self._cache[0] != key:
            angles, derivatives = self._prediction.derivatives(self._values(x), self._wanted)
            self._cache = (key, angles, derivatives)
            self.evaluations += 1
        return self._cache[1], self._cache[2]

    def _residual(self, x: Array) -> Array:
        angles, _ = self._evaluate(x)
        rows = self._prepared.usable
        data = self._weight * (angles - self._prepared.log.bend_angles)[rows]
        prior = ((x - self._start_scaled()) * self._scale / self._spread)[self._known]
        return np.concatenate([data.ravel(), prior])

    def _jacobian(self, x: Array) -> Array:
        _, derivatives = self._evaluate(x)
        rows = self._prepared.usable
        data: Array = self._weight * derivatives[rows].reshape(-1, len(x)) * self._scale
        prior = np.diag(self._scale / self._spread)[self._known]
        return np.concatenate([data, prior])

    def _start_scaled(self) -> Array:
        start = np.array([self._start[place] for place in self._wanted])
        return np.asarray(start / self._scale)


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


def _try_air(prepared: Prepared, warnings: list[str]) -> AirFit | None:
    try:
        return fit_air(prepared.log, CONTROL_PERIOD)
    except LogError as error:
        warnings.append(f"the chambers' lag keeps its old value: {error}")
        return None


def _pairs(unknowns: tuple[Unknown, ...], correlation: Array) -> tuple[tuple[str, str, float], ...]:
    count = len(unknowns)
    return tuple(
        (unknowns[i].name, unknowns[j].name, float(correlation[i, j]))
        for i in range(count)
        for j in range(i)
        if abs(correlation[i, j]) > STRONG
    )


def _finish(
    prior: Limb, found: Limb, air: AirFit | None, prepared: Prepared, remaining: Array
) -> Limb:
    pneumatics = prior.pneumatics
    if air is not None:
        pneumatics = replace(
            pneumatics,
            time_constant=air.fill_lag,
            vent_time_constant=air.vent_lag,
            delay=air.delay,
        )
        if np.isfinite(air.vent_rate):
            pneumatics = replace(
                pneumatics, vent_rate=air.vent_rate, vent_exponent=air.vent_exponent
            )
    rows = prepared.usable
    error = np.degrees(np.sqrt(np.nanmean(remaining**2, axis=0)))
    return replace(
        found,
        pneumatics=pneumatics,
        calibrated=CalibratedRange(
            tuple(float(v) for v in np.abs(prepared.pressure[rows]).max(axis=0)),
            tuple(float(v) for v in np.abs(prepared.bend[rows]).max(axis=0)),
        ),
        provenance={
            "source": prepared.log.source,
            "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "fitted_by": "der_planner.identification",
            "residual_deg": [round(float(v), 3) for v in error],
            "prior": prior.name,
        },
    )


__all__ = ["AirFit", "FitReport", "GeometryFit", "fit"]
