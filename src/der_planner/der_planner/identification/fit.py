"""From a log to a limb: air, lengths, statics, then everything at once on the rod's dynamics."""

from __future__ import annotations

import datetime
import time as clock
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.air import AirFit, fit_air
from der_planner.identification.geometry import (
    GeometryFit,
    Unevenness,
    UnevenTips,
    check_that_it_holds,
    fit_geometry,
    lengths_at_their_end,
    unevenness,
    with_geometry,
)
from der_planner.identification.logs.log import CalibrationLog, LogError
from der_planner.identification.logs.prepare import LONGEST_GAP, Prepared, prepare
from der_planner.identification.parameters import GROUPS, OPTIONAL, to_limb
from der_planner.identification.pcc_fit import fit_pcc
from der_planner.identification.problem import Problem
from der_planner.identification.report import FitReport, LoadsFit, Unknown, loads_of
from der_planner.identification.rod_angles import NODES
from der_planner.limb import CalibratedRange, Limb
from der_planner.model import RodModel
from der_planner.model.series import CONTROL_PERIOD
from der_planner.planning.loads import nearly_buckling

Array = NDArray[np.float64]

STRONG = 0.9
"""|correlation| above which two unknowns are reported as a pair that the log cannot tell apart."""
MOST_PASSES = 4
"""Largest number of times that lengths and bend angles are fitted in turn, for a limb that its
weight bends unevenly."""
SAME_LENGTH = 5e-4
"""A pass that changes no length by more than this is the last one [m]."""


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
        terms: model terms to fit beside gain and rest angle, of `GROUPS`; with ``mass`` (of
            `OPTIONAL`) the mass of each segment is fitted and its stiffness is the prior's. A log
            shows the mass only under gravity or in fast motion.
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
    if not groups <= {*GROUPS, *OPTIONAL}:
        known = (*GROUPS, *OPTIONAL)
        raise LogError(f"unknown model term {sorted(groups - set(known))}: choose {known}")
    prepared = prepare(log, limb, longest_gap=longest_gap)
    warnings = list(prepared.warnings)
    air = _try_air(prepared, warnings)
    offset = np.zeros(limb.segment_count) if air is None else air.offset
    fitted = _fit_bends_and_lengths(limb, prepared, offset, groups, nodes, geometry)
    if fitted.lengths is not None:
        warnings += filter(None, [lengths_at_their_end(limb, fitted.lengths.lengths)])
    unknowns, correlation = fitted.problem.uncertainties(fitted.values, fitted.jacobian)
    if "dynamics" in groups and _all_untold(unknowns):
        warnings.append(
            "the log is too slow to tell the stiffness apart from the gain: stiffness and damping "
            "keep their old values; steps or a sweep would tell them"
        )
        slow = Problem(fitted.limb, prepared, offset, groups - {"dynamics"}, nodes)
        fitted = _Fitted(fitted.limb, fitted.lengths, slow, *slow.solve())
        unknowns, correlation = slow.uncertainties(fitted.values, fitted.jacobian)
    remaining = fitted.problem.remaining(fitted.values)
    found = _finish(limb, to_limb(fitted.limb, fitted.values), air, prepared, remaining)
    warnings += filter(None, [nearly_buckling(found)])
    pcc_residual = np.full(limb.segment_count, np.nan)
    if "dynamics" in fitted.problem.groups or any(limb.gravity[:2]):
        found, pcc_residual = _with_arcs(found, prepared, offset, warnings)
    report = _report(
        log, prepared, unknowns, correlation, remaining, air=air, geometry=fitted.lengths,
        pcc_residual=pcc_residual, evaluations=fitted.problem.evaluations,
        fit_time=clock.perf_counter() - begin, warnings=tuple(warnings), loads=loads_of(found),
    )  # fmt: skip
    return found, report


class _Fitted(NamedTuple):
    """A limb with its lengths, and the problem that was solved on it with its solution."""

    limb: Limb
    lengths: GeometryFit | None
    problem: Problem
    values: Array
    jacobian: Array


def _fit_bends_and_lengths(
    limb: Limb,
    prepared: Prepared,
    offset: Array,
    groups: frozenset[str],
    nodes: int,
    geometry: bool,
) -> _Fitted:
    """Fit the lengths first, or in turn with the bend angles where weight bends the limb unevenly.

    The lengths follow from tips and bend angles only if it is known how unevenly each segment
    bends; that follows from a fitted limb, whose weight depends on its lengths. So both are fitted
    in turn until the lengths stay the same. How unevenly it bends also tells the stiffness.
    """
    loaded = any(limb.gravity[:2])
    prior = limb
    lengths = fit_geometry(limb, prepared.log) if geometry and not loaded else None
    if lengths is not None:
        limb = with_geometry(prior, lengths.lengths, lengths.connector, lengths.base)
    problem = Problem(limb, prepared, offset, groups, nodes)
    fitted = _Fitted(limb, lengths, problem, *problem.solve())
    bent: Unevenness | None = None
    for _ in range(MOST_PASSES if geometry and loaded else 0):
        found = to_limb(fitted.limb, fitted.values)
        bent = unevenness(found, prepared.log.time, prepared.pressure - offset, nodes)
        lengths = fit_geometry(prior, prepared.log, uneven=bent.tip)
        if lengths is None:
            break
        limb = with_geometry(prior, lengths.lengths, lengths.connector, lengths.base)
        tips = UnevenTips(
            prior, limb, prepared.log, prepared.usable, RodModel(limb, nodes), bent.lacking
        )
        problem = Problem(limb, prepared, offset, groups, nodes, fitted.values, tips)
        moved = np.abs(np.subtract(_lengths(limb), _lengths(fitted.limb))).max()
        fitted = _Fitted(limb, lengths, problem, *problem.solve())
        if moved < SAME_LENGTH:
            break
    if bent is not None and not bent.holds:
        found = to_limb(fitted.limb, fitted.values)
        check_that_it_holds(found, prepared.log.time, prepared.pressure - offset)
    return fitted


def _lengths(limb: Limb) -> list[float]:
    return [limb.base_length, *(segment.length for segment in limb.segments)]


def _all_untold(unknowns: tuple[Unknown, ...]) -> bool:
    stiffness = [u.untold for u in unknowns if u.name.startswith("log_stiff")]
    return bool(stiffness) and all(stiffness)


def _with_arcs(
    found: Limb, prepared: Prepared, offset: Array, warnings: list[str]
) -> tuple[Limb, Array]:
    """Return the limb with the PCC model's numbers, and that model's errors (M,) [rad]."""
    segments, residual = fit_pcc(found, prepared, offset)
    if np.all(np.isfinite(residual)):
        return replace(found, pcc_segments=segments), residual
    warnings.append(
        "arcs of constant curvature cannot follow this log under its loads: the PCC model has the "
        "rod's numbers"
    )
    return found, residual


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
    loads: LoadsFit | None,
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
        loads=loads,
    )


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
                pneumatics,
                vent_rate=air.vent_rate,
                vent_exponent=air.vent_exponent,
                vent_lag_exponent=air.vent_lag_exponent,
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
