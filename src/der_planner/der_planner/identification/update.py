"""What changes from day to day, gain, rest angle and friction, brought up to date from runs.

A calibration moves every chamber on purpose. An ordinary run tells less, so that only what changes
from day to day is asked of it, and the limb file with the spread of days around it is weighed
against the run. The errors are weighed by what the fit before left (at least 0.3° and 1 s: what a
model of this kind leaves anyhow). The prediction is open loop from the measured pressures. An
unknown whose standard deviation stays that of the days was not told by the run and keeps its value.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np

from der_planner.arrays import Array
from der_planner.identification.bends import (
    CORRELATION,
    LEAST_ERRORS,
    MOST_FITS,
    NODES,
    BendFit,
)
from der_planner.identification.least_squares import LeastSquares, Rows, with_differences
from der_planner.identification.log import LEAST_MOTION, CalibrationLog, LogError, Prepared, prepare
from der_planner.identification.report import readable
from der_planner.identification.terms import COLUMN, FreeTerms, to_limb, values_of
from der_planner.identification.told import UNTOLD
from der_planner.limb import Limb, Term
from der_planner.limb.parameters import REST_SPREAD
from der_planner.model import RodModel
from der_planner.rod import ConvergenceError

GAIN_SPREAD = 0.35
"""Share of a gain by which it changes from day to day: a real limb's changed by up to a half."""
MOST_GAIN = 4.0
"""Largest factor by which a fit may change a gain."""
MOST_REST_CHANGE = math.radians(35.0)
"""Largest change of a rest angle in a fit [rad]."""
FRICTION_SPREAD = 0.5
"""Share of a friction by which it changes from day to day."""
LEAST_FRICTION_SPREAD = 0.0042
"""Least change of a friction from day to day, as a share of the pressure limit."""
MOST_FRICTION_CHANGE = 20.0
"""Largest change of a friction in a fit, in spreads of a day."""
WRONG_WAY = -0.5
"""Correlation of predicted and measured bend below which pressure and bend have other signs."""
ONE_SIDED = 0.2
"""Share of the gain of one side that the other side has at least."""
BOTH_SIDES = 0.2
"""Share of the pressure to one side from which on the other side was driven, too."""
LEAST_DURATION = 5.0
"""Least duration of all runs together [s]."""
CALIBRATE_AGAIN = math.radians(3.0)
"""Root mean square error that a limb file should not leave [rad]."""

FAR = 3e-3
"""Mean distance of measured and expected tip beyond which a model is adapted [m]."""
TIP_ERROR = 2e-3
"""Error of the tip that a model leaves anyhow [m]."""
BETTER = 0.7
"""Share of the distance that an adapted model may leave to be used."""
_NUDGE = 1e-3
"""Change of an unknown in its spread, for a difference of two simulations."""


DAY_TERMS = ("gain", "rest_angle", "friction_pressure")
"""Terms that change from day to day."""


def _day_terms(limb: Limb, names: Collection[str] = DAY_TERMS) -> FreeTerms:
    """Return the terms of these names in all segments, with the spread of days."""
    values, angle = values_of(limb), COLUMN["friction_angle"]
    # A limb file without friction does not say over which bend it turns round.
    values[:, angle] = values_of(limb, starts=True)[:, angle]
    free = FreeTerms.of(limb, names, values)
    least = LEAST_FRICTION_SPREAD * limb.pneumatics.pressure_limit
    known = zip(free.terms, free.at_places(values).tolist(), strict=True)
    return replace(free, terms=tuple(_of_days(term, value, least) for term, value in known))


def _with_arcs_alike(before: Limb, found: Limb) -> Limb:
    """Return a limb that was found whose arcs have changed as the rod's segments have.

    Gain and friction of an arc change by the factors of its segment, its rest angle by as much.
    """
    if not before.pcc_segments:
        return found
    arcs = replace(before, segments=before.pcc_segments)
    of_arcs, of_rod = values_of(arcs), values_of(before)
    share = np.divide(of_arcs, of_rod, out=np.ones_like(of_rod), where=of_rod != 0.0)
    share[:, COLUMN["rest_angle"]] = 1.0
    changed = of_arcs + share * (values_of(found) - of_rod)
    return replace(found, pcc_segments=to_limb(arcs, changed).segments)


def _of_days(term: Term, value: float, least_friction: float) -> Term:
    """Return one of `DAY_TERMS` with what is known of it in a limb whose file gives a value.

    A friction's spread is at least ``least_friction`` [Pa].
    """
    if term.name == "gain":
        spread, low, high = GAIN_SPREAD * value, value / MOST_GAIN, value * MOST_GAIN
    elif term.name == "rest_angle":
        spread, low, high = REST_SPREAD, value - MOST_REST_CHANGE, value + MOST_REST_CHANGE
    else:
        spread = max(FRICTION_SPREAD * value, least_friction)
        low, high = 0.0, value + MOST_FRICTION_CHANGE * spread
    return replace(term, spread=spread, scale=spread, low=low, high=high)


@dataclass(frozen=True)
class Change:
    """One number of a limb file before and after an update.

    Attributes:
        segment: from 0.
        term: of `DAY_TERMS`, with its unit and the spread of days.
        before, after: values.
        deviation: standard deviation after; the spread of days where the runs do not tell it.
    """

    segment: int
    term: Term
    before: float
    after: float
    deviation: float

    @property
    def told(self) -> bool:
        """Whether the runs tell it; if not, it keeps its value."""
        return self.deviation < self.term.spread

    def text(self) -> str:
        """Return the line for people."""
        factor, unit = readable(self.term.unit)
        before, after = factor * self.before, factor * self.after
        spread, deviation = factor * self.term.spread, factor * self.deviation
        name = self.term.name.replace("_", " ")
        line = f"segment {self.segment}, {name}: {before:.3g} ± {spread:.2g} {unit}"
        if not self.told:
            return f"{line} stays: not told by these runs"
        line += f" -> {after:.3g} ± {deviation:.2g} {unit}"
        if self.term.name == "gain":
            return f"{line} ({100 * (after / before - 1):+.1f} %)"
        return f"{line} ({after - before:+.2g} {unit})"


@dataclass(frozen=True)
class Update:
    """What ordinary runs said of a limb file.

    Attributes:
        changes: three a segment, in the order gain, rest angle, friction.
        error_before, error_after: (M,) root mean square open-loop error of the bend angles [rad].
        warnings: sentences.
    """

    changes: tuple[Change, ...]
    error_before: Array
    error_after: Array
    warnings: tuple[str, ...]

    @property
    def told(self) -> bool:
        """Whether the runs told anything."""
        return any(change.told for change in self.changes)

    @property
    def enough(self) -> bool:
        """Whether the updated limb file predicts the runs; if not, the limb must be calibrated."""
        return bool(np.all(self.error_after < CALIBRATE_AGAIN))

    def text(self) -> str:
        """Return the result for people."""
        lines = [change.text() for change in self.changes]
        pairs = zip(self.error_before, self.error_after, strict=True)
        lines += [
            f"segment {index}: open-loop error rms {math.degrees(before):.2f}° -> "
            f"{math.degrees(after):.2f}°"
            for index, (before, after) in enumerate(pairs)
        ]
        return "\n".join([*lines, *(f"finding: {text}" for text in self.warnings)])


def update(limb: Limb, logs: CalibrationLog | Sequence[CalibrationLog]) -> tuple[Limb, Update]:
    """Bring gain, rest angle and friction of a limb up to date from ordinary runs.

    Args:
        limb: as its file says, under the loads of the runs.
        logs: one or more runs of one day: half a minute in which both segments move tells all.

    Returns:
        The limb with the numbers that the runs tell, and how they changed. The arcs' own gain and
        friction change by the same factors, their rest angle by the same difference.

    Raises:
        LogError: a log cannot be used, see `prepare`; the runs are too short; the rod cannot follow
            them; or they ask for a change that no day makes.
    """
    given = [logs] if isinstance(logs, CalibrationLog) else list(logs)
    runs = [prepare(log, limb, to_fit=False) for log in given]
    duration = sum(float(np.ptp(run.log.time)) for run in runs)
    if duration < LEAST_DURATION:
        raise LogError(
            f"the runs last {duration:.1f} s altogether: an update needs {LEAST_DURATION:.0f} s, "
            "and half a minute in which all segments move to tell all of it"
        )
    every = _day_terms(limb)
    whole, known = BendFit(every, RodModel(limb, NODES), runs), every.unknowns.prior
    try:
        remaining = whole.remaining(known)
    except ConvergenceError as error:
        raise LogError(
            f"the rod of the limb '{limb.name}' cannot follow these runs: check that they are of "
            "this limb, with its mounting and what it carries"
        ) from error
    _refuse_other_limbs(runs, remaining)
    values, deviation = _solve(every, runs)
    before, after = (
        np.sqrt(np.nanmean(left**2, axis=0)) for left in (remaining, whole.remaining(values))
    )
    warnings = [warning for run in runs for warning in run.warnings]
    if not np.all(after < CALIBRATE_AGAIN):
        warnings.append(
            f"gain, rest angle and friction leave {math.degrees(after.max()):.1f}°: something else "
            "changed, calibrate again"
        )
    changes = tuple(
        Change(segment, term, *numbers)
        for (segment, _), term, *numbers in zip(
            every.places, every.terms, known, values, deviation, strict=True
        )
    )
    pressure = np.concatenate([run.pressure[run.usable] for run in runs])
    warnings += [
        f"segment {change.segment} was driven to one side only: that the gain of the other side "
        "has changed alike is not told by these runs"
        for change in changes
        if change.term.name == "gain" and change.told and _one_sided(pressure[:, change.segment])
    ]
    note = {
        "source": [log.source for log in given],
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "changes": [change.text() for change in changes if change.told],
        "residual_deg_before": limb.provenance.get("residual_deg"),
    }
    residual = [round(float(value), 3) for value in np.degrees(after)]
    provenance = {**limb.provenance, "residual_deg": residual, "update": note}
    found = replace(_with_arcs_alike(limb, every.limb_with(values)), provenance=provenance)
    return found, Update(changes, before, after, tuple(warnings))


def _solve(every: FreeTerms, runs: Sequence[Prepared]) -> tuple[Array, Array]:
    """Return the values (P,) and their deviations (P,), both as known before where not told."""
    known, errors = every.unknowns, None
    values, deviation, told = known.prior, known.spread, np.ones(len(known.prior), dtype=bool)
    for _ in range(MOST_FITS):
        problem = BendFit(every.only(told), RodModel(every.limb, NODES), runs)
        if errors is not None:
            problem.weigh(errors)
        found = problem.search.solve(values[told])
        errors = np.maximum(problem.errors_left(found), LEAST_ERRORS)
        problem.weigh(errors)
        of_found = np.sqrt(np.diag(problem.search.covariance(found)))
        better = of_found <= UNTOLD * known.spread[told]
        told[told] = better
        values, deviation = known.prior.copy(), known.spread.copy()
        values[told], deviation[told] = found[better], of_found[better]
        if not told.any():
            break
    return values, deviation


def _one_sided(pressure: Array) -> bool:
    """Return whether a pressure (K,) drives a segment to one side only."""
    least, most = sorted((float(pressure.max()), -float(pressure.min())))
    return least < BOTH_SIDES * most


def _refuse_other_limbs(runs: Sequence[Prepared], remaining: Array) -> None:
    """Refuse runs in which a segment bends as no day makes it.

    Args:
        runs: prepared.
        remaining: (K, M) measured less predicted bend of all runs [rad].

    Raises:
        LogError: a segment bends against its pressure, with another's, or to one side only.
    """
    rows = np.isfinite(remaining).all(axis=1)
    measured = np.concatenate([run.log.bend_angles for run in runs])[rows]
    expected = measured - remaining[rows]
    moved = np.minimum(np.ptp(measured, axis=0), np.ptp(expected, axis=0)) >= LEAST_MOTION
    for m in map(int, np.flatnonzero(moved)):
        seen, told = measured[:, m], expected[:, m]
        alike = {int(n): np.corrcoef(seen, expected[:, n])[0, 1] for n in np.flatnonzero(moved)}
        most = max(alike, key=alike.__getitem__)
        if alike[m] < WRONG_WAY:
            raise LogError(
                f"segment {m} bends the wrong way in these runs: check that they are of this limb, "
                "that no tubes, signs or columns are swapped, and that what it carries is named; "
                "else calibrate again"
            )
        if alike[m] < 0.5 and alike[most] > 0.8:
            raise LogError(
                f"segment {m} bends with input {most}, not with input {m}: columns or tubes are "
                "swapped, or the runs are of another limb"
            )
        if min(told.max(), -told.min()) < 2.0 * LEAST_MOTION:
            continue
        sides = {"left": told > LEAST_MOTION, "right": told < -LEAST_MOTION}
        gains = {name: np.polyfit(told[side], seen[side], 1)[0] for name, side in sides.items()}
        worst = min(gains, key=gains.__getitem__)
        if gains[worst] < ONE_SIDED * max(gains.values()):
            raise LogError(
                f"segment {m} bends to the {worst} by {abs(100 * gains[worst]):.0f} % of what its "
                "pressure should do, to the other side as it should: a chamber or tube there leaks"
            )


def adapted(limb: Limb, tip_of: Callable[[Limb], Array | None], tip: Array) -> Limb | None:
    """Return a limb with gains and rest angles under which its tip comes nearest to a run's.

    Learning plans with the model's answer to a change of commands. Where a limb is far from its
    file, of another day or another limb altogether, that answer is wrong as well, and a step by it
    may make things worse. So what the tip tells of the day is put into the model first; `update`
    takes it from bend angles and measured pressures, which tell more.

    Args:
        limb: of the plan.
        tip_of: gives the tip (K, 2) [m] of such a limb in the run; None where it has none.
        tip: (K, 2) measured, NaN where it was not seen [m].

    Returns:
        None where the limb is near the run already, or nothing much is gained.
    """
    seen = np.isfinite(tip).all(axis=1)
    numbers = _day_terms(limb, ("gain", "rest_angle"))
    unknowns = numbers.unknowns

    def limb_with(values: Array) -> Limb:
        return _with_arcs_alike(limb, numbers.limb_with(values))

    def missed(values: Array) -> Array:
        found = tip_of(limb_with(values))
        return np.full((int(seen.sum()), 2), np.nan) if found is None else (found - tip)[seen]

    def rows(values: Array) -> Rows:
        weight = 1.0 / (TIP_ERROR * math.sqrt(CORRELATION))
        residual, slopes = with_differences(
            lambda v: weight * missed(v).ravel(), values, _NUDGE * unknowns.spread
        )
        return residual, lambda: np.nan_to_num(slopes())

    def far(values: Array) -> float:
        return float(np.linalg.norm(missed(values), axis=1).mean())

    before = far(unknowns.prior)
    if not before >= FAR:
        return None
    found = LeastSquares(unknowns, rows).solve()
    return limb_with(found) if far(found) < BETTER * before else None
