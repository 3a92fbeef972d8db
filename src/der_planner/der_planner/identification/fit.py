"""From a log to a limb: air, lengths, statics, then everything at once on the model's dynamics."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Collection, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from der_planner.arrays import Array
from der_planner.estimation.hindsight import Filmed, free_level
from der_planner.identification.air import AirFit, fit_air
from der_planner.identification.bends import MOST_FITS, NODES, BendFit, Predicted
from der_planner.identification.least_squares import Rows
from der_planner.identification.lengths import (
    GeometryFit,
    GivesWayError,
    fit_geometry,
    lengths_at_their_end,
    lengths_of,
    uneven_tips,
    unevenness,
)
from der_planner.identification.log import (
    LONGEST_GAP,
    CalibrationLog,
    LogError,
    Prepared,
    prepare,
)
from der_planner.identification.report import FitReport
from der_planner.identification.stiffness import HungWeight, stiffness_in_motion
from der_planner.identification.terms import (
    COLUMN,
    GROUPS,
    OPTIONAL,
    TERMS,
    FreeTerms,
    values_of,
    without,
)
from der_planner.identification.told import (
    against_motion,
    at_bounds,
    kept_unknowns,
    measured_stiffness,
    told,
    untold_stiffness,
)
from der_planner.limb import CalibratedRange, Limb
from der_planner.model import CONTROL_PERIOD, ArcModel, Material, RodModel
from der_planner.planning.loads import nearly_buckling
from der_planner.rod import ConvergenceError

MOST_PASSES = 4
"""Largest number of times that lengths and bend angles are fitted in turn, for a limb that its
weight bends unevenly."""
SAME_LENGTH = 5e-4
"""Change of a length up to which a pass is the last one [m]."""
COMPLIANCE_SPREAD = 0.3
"""Relative standard deviation of the prior's compliance in the start in closed form."""
EVEN_ERROR = np.deg2rad(5.0)
"""Error of the bend angle of an evenly bent segment in the start in closed form [rad]."""
LARGEST_CHANGE = 0.6
"""Largest change of the logarithm of the stiffness in the start in closed form."""
SHORTEST_DELAY, SHORTEST_LEAD = 0.005, 0.15
"""A fit is repeated without a delay of what was seen from this on, or a lead [s]. No camera leads:
up to 0.1 s are friction that passes for a lead, and without it other logs are predicted worse."""
STIFFER_STARTS = (0.0, 0.25, 0.5, 0.9)
"""Added to the logarithm of the stiffness, or taken off that of the mass, until the rod can follow
the log from there."""
FARTHEST_WEIGHT = 1.5
"""Place of a known weight, over the prior's length, beyond which it is not in metres."""
FREE_LEVEL_TOLD = 300.0
"""Time from the beginning of a log that tells the free level [s]."""
MISSED = 0.1
"""Error that a fit leaves, over the range of bend angles, from which on it misses the log."""
_MISSES_ITS_LOG = (
    "the limb that fits the log best misses it: was it mounted and loaded as said (--mounting, "
    "--payload), are units and columns right, is each angle the bend of its own segment alone, and "
    "do angles and pressures have one clock?"
)
_NO_CUBIC = (
    "the cubic term is left out: with it the limb that fits the log best gives way under its "
    "pressures, since under gravity that term is hardly told from stiffness and rest angle"
)


def fit(
    limb: Limb,
    log: CalibrationLog,
    *,
    terms: Iterable[str] = GROUPS,
    longest_gap: float = LONGEST_GAP,
    weight: tuple[float, float] | None = None,
) -> tuple[Limb, FitReport]:
    """Identify a limb from a calibration run.

    Args:
        limb: geometry, masses, limits and first guesses; mass and axial stiffness are kept.
        log: of a calibration run, or of any run that excites every input.
        terms: model terms to fit beside gain and rest angle, of `GROUPS`; with ``mass`` (of
            `OPTIONAL`) the mass of each segment is fitted and its stiffness is the prior's. A log
            shows the mass only under gravity or in fast motion.
        longest_gap: between two rows of the log that a straight line may bridge [s].
        weight: mass [kg] and place along the limb [m] of a weight that was hung on the resting limb
            at the end of the log, see `HungWeight`; None: none was.

    Returns:
        The identified limb, with provenance and calibrated ranges, and what the data say of it.

    Raises:
        LogError: the log cannot tell the limb; the message names what is missing.
    """
    groups = frozenset(terms)
    if not groups <= {*GROUPS, *OPTIONAL}:
        known = (*GROUPS, *OPTIONAL)
        raise LogError(f"unknown model term {sorted(groups - set(known))}: choose {known}")
    if weight and ("dynamics" not in groups or "mass" in groups):
        raise LogError(
            "a known weight tells the stiffness: leave dynamics among the terms, and the mass out"
        )
    if weight and not 0.0 < weight[1] <= FARTHEST_WEIGHT * limb.length:
        raise LogError(
            f"the weight is said to hang at {weight[1]:g} m along a limb of {limb.length:.3g} m: "
            "give metres from its clamp (--at), or the limb's lengths in the limb file of --prior"
        )
    return _fit(limb, log, groups, longest_gap, weight)


def _with_free_level(limb: Limb, log: CalibrationLog, unlike: float) -> Limb:
    """Return the limb with what the log tells of the free level, by which feedback feels touch.

    Args:
        limb: as it was identified.
        log: of its run.
        unlike: how far its tips are from where its bends put them, in any run [m].
    """
    grid = log.between(log.time[0], log.time[0] + FREE_LEVEL_TOLD).resampled(CONTROL_PERIOD)
    time, held = grid.time - grid.time[0], grid.measured_differential
    asked = np.where(np.isfinite(grid.commanded_differential), grid.commanded_differential, held)
    filmed = Filmed(time, held, time, grid.bend_angles, grid.tip)
    try:
        told = free_level(limb, time, np.nan_to_num(asked), filmed, unlike)
        return replace(limb, calibrated=replace(limb.calibrated, free_level=told))
    except (ValueError, ConvergenceError):  # no tips, or a limb that gives way
        return limb


def _fit(
    limb: Limb,
    log: CalibrationLog,
    groups: Collection[str],
    longest_gap: float,
    weight: tuple[float, float] | None,
    taken_out: float = 0.0,
) -> tuple[Limb, FitReport]:
    """Identify a limb from a log from whose stamps a delay [s] was taken off."""
    recorded = prepare(log, limb, longest_gap)
    hung = HungWeight.found(recorded, *weight) if weight else None
    if hung is not None:
        recorded = recorded.without(hung.rows)
    warnings = list(recorded.warnings)
    try:
        air = fit_air(recorded.log, limb.pneumatics)
    except LogError as error:
        air = None
        warnings.append(f"the chambers' lag keeps its old value: {error}")
    offset = 0.0 if air is None else air.offset
    prepared = replace(recorded, pressure=recorded.pressure - offset)
    fitted = _fit_bends_and_lengths(limb, prepared, groups, warnings)
    at_end = lengths_at_their_end(limb, fitted.free.limb)
    warnings += filter(None, [at_end])
    if hung is not None:
        change, deviation = hung.stiffness_change(fitted.free.limb, fitted.limb)
        moved, _ = told(fitted.problem, fitted.values)
        warnings += against_motion(moved, change, deviation)
        weighed = fitted.free.told("log_stiffness", change, deviation)
        fitted = _again(fitted, weighed, prepared)
    unknowns, correlation = told(fitted.problem, fitted.values)
    kept, said = untold_stiffness(fitted.free, unknowns)
    without_kept = _again(fitted, fitted.free.only(~kept), prepared) if kept.any() else fitted
    if without_kept is not fitted:
        left = tuple(kept_unknowns(fitted.free.only(kept)))
        fitted = without_kept
        unknowns, correlation = told(fitted.problem, fitted.values)
        unknowns += left
        warnings.append(said)
    late, doubt = fitted.problem.delay(fitted.values)
    shortest = SHORTEST_DELAY if late > 0.0 else SHORTEST_LEAD
    if not taken_out and abs(late) >= max(shortest, 3.0 * doubt):
        # What was seen late would pass for damping and inertia.
        return _fit(limb, log.seen_earlier(late, longest_gap), groups, longest_gap, weight, late)
    warnings += at_bounds(fitted.free, fitted.values)
    found = _calibrated(fitted, limb, air, recorded)
    span = np.ptp(prepared.bend[prepared.usable], axis=0)
    if np.any(fitted.residual > MISSED * span):
        warnings.append(_MISSES_ITS_LOG)
    warnings += filter(None, [nearly_buckling(found)])
    pcc_residual = np.full(limb.segment_count, np.nan)
    if limb.weighs_in_plane or any(term.group == "dynamics" for term in fitted.free.terms):
        found, pcc_residual = _with_arcs(found, fitted, prepared, warnings)
    unlike = fitted.lengths.residual if at_end and fitted.lengths else 0.0
    found = _with_free_level(found, log, unlike)
    return found, FitReport(
        limb=found,
        source=log.source,
        unknowns=unknowns,
        correlation=correlation,
        air=air,
        geometry=fitted.lengths,
        residual=fitted.residual,
        largest=np.nanmax(np.abs(fitted.remaining), axis=0),
        pcc_residual=pcc_residual,
        span=span,
        duration=float(np.ptp(prepared.log.time)),
        rows=int(prepared.usable.sum()),
        delay=(taken_out + late, doubt),
        taken_out=taken_out,
        warnings=tuple(warnings),
        weight="" if hung is None else str(hung),
    )


class _Fitted(NamedTuple):
    """The problem of a limb with its lengths, and the values that solve it.

    What the log did not tell is in ``kept``, pairs of segment and term.
    """

    lengths: GeometryFit | None
    problem: BendFit
    values: Array
    kept: frozenset[tuple[int, int]] = frozenset()

    @property
    def free(self) -> FreeTerms:
        """The terms that were free, of the limb as it was known before."""
        return self.problem.free

    @property
    def limb(self) -> Limb:
        """The limb that was found."""
        return self.free.limb_with(self.values)

    @property
    def remaining(self) -> Array:
        """What is left of the bend angles (K, M) [rad]."""
        return self.problem.remaining(self.values)

    @property
    def residual(self) -> Array:
        """Root mean square (M,) of what is left of the bend angles [rad]."""
        return np.asarray(np.sqrt(np.nanmean(self.remaining**2, axis=0)))

    def of_places(self, free: FreeTerms) -> Array:
        """Return the values (P,) of some of the terms."""
        found = dict(zip(self.free.places, self.values, strict=True))
        return np.array([found[place] for place in free.places])


def _fit_bends_and_lengths(
    prior: Limb, prepared: Prepared, groups: Collection[str], warnings: list[str]
) -> _Fitted:
    """Fit the lengths first, or in turn with the bend angles where weight bends the limb unevenly.

    The lengths follow from tips and bend angles only if it is known how unevenly each segment
    bends; that follows from a fitted limb, whose weight depends on its lengths. So both are fitted
    in turn until the lengths stay the same. How unevenly it bends also tells the stiffness. The rod
    of the planners must follow the log, too.
    """
    loaded = prior.weighs_in_plane
    lengths = fit_geometry(prior, prepared.log) if not loaded else None
    fitted = _fit_bends(lengths.limb if lengths else prior, prepared, groups, lengths)
    passes = MOST_PASSES
    while loaded:
        try:
            uneven, lacking = unevenness(fitted.limb, prepared, NODES)
        except GivesWayError:
            if "cubic" not in groups:
                raise
            warnings.append(_NO_CUBIC)
            groups, passes = set(groups) - {"cubic"}, MOST_PASSES
            known, tips = fitted.free.limb, fitted.problem.more_rows
            fitted = _fit_bends(known, prepared, groups, lengths, fitted, tips)
            continue
        if passes == 0:
            break
        passes -= 1
        lengths = fit_geometry(prior, prepared.log, uneven)
        if lengths is None:
            break
        tips = uneven_tips(prior, RodModel(lengths.limb, NODES), prepared, lacking)
        change = np.abs(lengths_of(lengths.limb) - lengths_of(fitted.free.limb))
        fitted = _fit_bends(lengths.limb, prepared, groups, lengths, fitted, tips)
        if change[: prior.segment_count + 1].max() < SAME_LENGTH:
            passes = 0
    return fitted


def _fit_bends(
    known: Limb,
    prepared: Prepared,
    groups: Collection[str],
    lengths: GeometryFit | None,
    before: _Fitted | None = None,
    tips: Callable[[Predicted], Rows] | None = None,
) -> _Fitted:
    """Fit the rod to the bend angles.

    Args:
        known: the limb before, with the lengths that were fitted.
        prepared: the log.
        groups: of terms to fit.
        lengths: of the limb.
        before: a fit of these terms, and others, to begin at; None: in closed form from statics.
        tips: fit to them, too; None: to the bend angles alone.
    """
    names = {term.name for term in TERMS if term.group in ("linear", *groups)}
    if "mass" in groups:
        names.discard("log_stiffness")
    if "mass" in groups or not known.weighs_in_plane:
        # Without weight, or with an unknown mass, it is one scale with the stiffness.
        names.discard("log_inertia")
    free = FreeTerms.of(known, names, without(values_of(known, starts=True), groups))
    if not known.weighs_in_plane:
        free = free.told("log_stiffness", *stiffness_in_motion(known, prepared))
    problem = BendFit(free, RodModel(known, NODES), [prepared], tips)
    if before is None:
        start = free.at_places(_static_start(free, prepared))
    else:
        start = before.of_places(free)
        problem.weigh(before.problem.errors)
    # In turn with the lengths the weights are found, too, so that one search a pass will do.
    most = 1 if known.weighs_in_plane else MOST_FITS
    return _Fitted(lengths, problem, problem.solve(_followed(problem, free, start), most))


def _static_start(free: FreeTerms, prepared: Prepared) -> Array:
    """Return values (M, T) by fitting bend = gain · pressure + compliance · torque + rest.

    The torque is that of the weight of evenly bent segments at the measured bend angles. Without
    gravity it is zero, and the compliance stays the prior's.
    """
    rows = prepared.usable
    pressure, bend = prepared.pressure[rows], prepared.bend[rows]
    values, weight = free.values.copy(), Material(free.limb).weight_torques(bend)
    doubt = EVEN_ERROR / COMPLIANCE_SPREAD * np.sqrt(len(bend))
    for index, segment in enumerate(free.limb.segments):
        spread = float(np.std(pressure[:, index]))
        known = segment.length / segment.bending_stiffness
        design = np.stack(
            [pressure[:, index] / spread, known * weight[:, index], np.ones(len(pressure))], axis=1
        )
        # The last row is what is known of the compliance, as one more measurement.
        design = np.concatenate([design, [[0.0, doubt, 0.0]]])
        seen = np.append(bend[:, index], doubt)
        gain, compliance, rest = np.linalg.lstsq(design, seen, rcond=None)[0]
        stiffer = np.clip(-np.log(max(compliance, 1e-3)), -LARGEST_CHANGE, LARGEST_CHANGE)
        places = [COLUMN[term] for term in ("gain", "rest_angle", "log_stiffness")]
        values[index, places] = gain / spread, rest, values[index, places[2]] + stiffer
    return values


def _followed(problem: BendFit, free: FreeTerms, start: Array) -> Array:
    """Return a start that the rod can follow: stiffer, or lighter, if it must be.

    Raises:
        LogError: the rod cannot follow the log from any start.
    """
    names = [term.name for term in free.terms]
    more = np.array([(n == "log_stiffness") - 1.0 * (n == "log_mass") for n in names])
    for share in STIFFER_STARTS if more.any() else STIFFER_STARTS[:1]:
        if problem.search.follows(start + share * more):
            return start + share * more
    raise LogError(
        "the rod cannot follow this log, neither with the prior's stiffness nor with more: "
        "check the prior's gravity, mass, masses and lengths, and that x points along the "
        "straight limb"
    )


def _again(fitted: _Fitted, free: FreeTerms, prepared: Prepared) -> _Fitted:
    """Fit terms that were fitted before, some of them or with more known of them.

    Returns what was given where the rod cannot follow the log from there.
    """
    before, start = fitted.problem, fitted.of_places(free)
    problem = BendFit(free, RodModel(free.limb, NODES), [prepared], before.more_rows)
    problem.weigh(before.errors)
    if not problem.search.follows(start):
        return fitted
    kept = fitted.kept.union(set(fitted.free.places) - set(free.places))
    return _Fitted(fitted.lengths, problem, problem.solve(start), kept)


def _with_arcs(
    found: Limb, fitted: _Fitted, prepared: Prepared, warnings: list[str]
) -> tuple[Limb, Array]:
    """Return the limb with the PCC model's numbers, and that model's errors (M,) [rad].

    Without gravity both models have the same statics, segment by segment, so gain, rest angle,
    unequal chambers, stiffening, friction and creep are shared, and only stiffness and damping are
    fitted to each: an arc is stiffer than a rod that may bend unevenly. Under gravity their statics
    differ as well, and the arcs get gains and rest angles of their own from the same log.
    """
    names = {"log_stiffness", "material_damping", "log_damping"}
    if found.weighs_in_plane:
        names |= {"gain", "rest_angle"}
    free = FreeTerms.of(found, names)
    # What the log does not tell of the rod it does not tell of the arcs either.
    free = free.only(np.array([place not in fitted.kept for place in free.places]))
    problem = BendFit(free, ArcModel(found), [prepared])
    problem.weigh(fitted.problem.errors)
    if not problem.search.follows(free.unknowns.prior):
        warnings.append(
            "arcs of constant curvature cannot follow this log under its loads: the PCC model has "
            "the rod's numbers"
        )
        return found, np.full(found.segment_count, np.nan)
    values = problem.search.solve()
    residual = np.sqrt(np.nanmean(problem.remaining(values) ** 2, axis=0))
    return replace(found, pcc_segments=free.limb_with(values).segments), residual


def _calibrated(fitted: _Fitted, prior: Limb, air: AirFit | None, recorded: Prepared) -> Limb:
    """Return the limb that was found, with its air, what the log covered and where it is from."""
    rows = recorded.usable
    return replace(
        fitted.limb,
        pcc_segments=(),
        pneumatics=air.law(prior.pneumatics) if air else prior.pneumatics,
        calibrated=CalibratedRange(
            tuple(float(v) for v in np.abs(recorded.pressure[rows]).max(axis=0)),
            tuple(float(v) for v in np.abs(recorded.bend[rows]).max(axis=0)),
            bending_stiffness=measured_stiffness(fitted.problem, fitted.values),
        ),
        provenance={
            "source": recorded.log.source,
            "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
            "fitted_by": "der_planner.identification",
            "residual_deg": [round(float(v), 3) for v in np.degrees(fitted.residual)],
            "prior": prior.name,
        },
    )
