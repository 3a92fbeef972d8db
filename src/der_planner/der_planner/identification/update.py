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
from der_planner.identification.bends import CORRELATION, NODES, BendFit
from der_planner.identification.fit import UNTOLD
from der_planner.identification.least_squares import (
    LeastSquares,
    Rows,
    Unknowns,
    with_differences,
)
from der_planner.identification.log import CalibrationLog, LogError, Prepared, prepare
from der_planner.identification.report import LEAST_MOTION
from der_planner.limb import Limb, Segment
from der_planner.limb.parameters import REST_SPREAD
from der_planner.model import RodModel
from der_planner.rod import ConvergenceError

GAIN_SPREAD = 0.35
"""Share of a gain by which it changes from day to day: a real limb's changed by up to a half."""
LARGEST_GAIN_CHANGE = 4.0
"""Largest factor by which a fit may change a gain."""
LARGEST_REST_CHANGE = math.radians(35.0)
"""Largest change of a rest angle in a fit [rad]."""
FRICTION_SPREAD = 0.5
"""Share of a friction by which it changes from day to day."""
LEAST_FRICTION_SPREAD = 100.0
"""Least change of a friction from day to day, as a pressure [Pa]."""
LARGEST_FRICTION_CHANGE = 20.0
"""Largest change of a friction in a fit, in spreads of a day."""
FRICTION_ANGLE = 0.1
"""Bend over which friction turns round, for a limb file without friction [rad]."""
WRONG_WAY = -0.5
"""Correlation of predicted and measured bend below which pressure and bend have other signs."""
LEAST_DURATION = 5.0
"""Least duration of all runs together [s]."""
CALIBRATE_AGAIN = math.radians(3.0)
"""Root mean square error that a limb file should not leave [rad]."""
MOST_PASSES = 3
"""Largest number of fits, each with the weights and without the untold unknowns of the last."""

FAR = 3e-3
"""Mean distance of measured and expected tip beyond which a model is adapted [m]."""
TIP_ERROR = 2e-3
"""Error of the tip that a model leaves anyhow [m]."""
BETTER = 0.7
"""Share of the distance that an adapted model may leave to be used."""
_NUDGE = 1e-3
"""Change of an unknown in its spread, for a difference of two simulations."""


NUMBERS = {
    "gain": "moment_gain",
    "rest angle": "rest_curvature",
    "friction": "friction_moment",
}
"""Field of `Segment` of each number that changes from day to day."""


@dataclass(frozen=True)
class DayNumbers:
    """The numbers of a limb that change from day to day: `NUMBERS` of each segment.

    Attributes:
        limb: with the numbers of its file.
        free: (P,) places of those that may change among all (3 M).
    """

    limb: Limb
    free: list[int]

    @classmethod
    def of(cls, limb: Limb, names: Collection[str] = tuple(NUMBERS)) -> DayNumbers:
        """Return the numbers of these names in all segments."""
        free = [name in names for name in NUMBERS] * limb.segment_count
        return cls(limb, np.flatnonzero(free).tolist())

    @property
    def unknowns(self) -> Unknowns:
        """What is known of the free numbers: those of the file, with the spread of days."""
        prior, spread, low, high = self._known[self.free].T
        return Unknowns(prior, spread, low, high, scale=spread)

    @property
    def _known(self) -> Array:
        """Prior, spread, least and largest value of all numbers (3 M, 4)."""
        return np.array([row for segment in self.limb.segments for row in _day(segment)])

    def limb_with(self, values: Array) -> Limb:
        """Return the limb with the free numbers (P,) put in place, its arcs changed alike."""
        numbers = self._known[:, 0]
        numbers[self.free] = values
        rows = numbers.reshape(self.limb.segment_count, -1).tolist()
        segments = tuple(map(_changed, self.limb.segments, rows))
        pairs = zip(self.limb.pcc_segments, self.limb.segments, segments, strict=False)
        return replace(self.limb, segments=segments, pcc_segments=tuple(_alike(*p) for p in pairs))


def _day(segment: Segment) -> list[tuple[float, float, float, float]]:
    """Return prior, spread, least and largest value of a segment's `NUMBERS`."""
    gain, rest, friction = segment.moment_gain, segment.rest_curvature, segment.friction_moment
    turned = LARGEST_REST_CHANGE / segment.length
    rubs = max(FRICTION_SPREAD * friction, LEAST_FRICTION_SPREAD * gain)
    return [
        (gain, GAIN_SPREAD * gain, gain / LARGEST_GAIN_CHANGE, gain * LARGEST_GAIN_CHANGE),
        (rest, REST_SPREAD / segment.length, rest - turned, rest + turned),
        (friction, rubs, 0.0, friction + LARGEST_FRICTION_CHANGE * rubs),
    ]


def _sizes(segment: Segment) -> tuple[float, float, float]:
    """Return gain, rest angle and friction of a `Change` over the fields that hold them."""
    return segment.length / segment.bending_stiffness, segment.length, 1.0


def _changed(segment: Segment, numbers: Sequence[float]) -> Segment:
    """Return a segment with other `NUMBERS`."""
    changes = dict(zip(NUMBERS.values(), numbers, strict=True))
    if changes["friction_moment"] and not segment.friction_curvature:
        changes["friction_curvature"] = FRICTION_ANGLE / segment.length
    return replace(segment, **changes)


def _alike(arc: Segment, before: Segment, after: Segment) -> Segment:
    """Return an arc changed as its segment was: gain and friction by factors, rest by a shift."""
    gain = arc.moment_gain * after.moment_gain / before.moment_gain
    friction = after.friction_moment
    if before.friction_moment:
        friction *= arc.friction_moment / before.friction_moment
    return replace(
        arc,
        moment_gain=gain,
        rest_curvature=arc.rest_curvature + after.rest_curvature - before.rest_curvature,
        friction_moment=friction,
        friction_curvature=arc.friction_curvature or after.friction_curvature,
    )


@dataclass(frozen=True)
class Change:
    """One number of a limb file before and after an update.

    Attributes:
        segment: from 0.
        name: ``gain`` [rad/Pa], ``rest angle`` [rad] or ``friction`` [N·m].
        before, after: values.
        spread: standard deviation before, that of days.
        deviation: standard deviation after.
    """

    segment: int
    name: str
    before: float
    after: float
    spread: float
    deviation: float

    @property
    def told(self) -> bool:
        """Whether the runs tell it; if not, it keeps its value."""
        return self.deviation < self.spread

    def text(self) -> str:
        """Return the line for people."""
        factor, unit = {
            "gain": (math.degrees(100.0), "°/hPa"),
            "rest angle": (math.degrees(1.0), "°"),
            "friction": (1e3, "mN·m"),
        }[self.name]
        before, after, spread, deviation = (
            factor * value for value in (self.before, self.after, self.spread, self.deviation)
        )
        line = f"segment {self.segment}, {self.name}: {before:.3g} ± {spread:.2g} {unit}"
        if not self.told:
            return f"{line} stays: not told by these runs"
        line += f" -> {after:.3g} ± {deviation:.2g} {unit}"
        if self.name == "gain":
            return f"{line} ({100 * (after / before - 1):+.1f} %)"
        return f"{line} ({after - before:+.2g} {unit})"


@dataclass(frozen=True)
class Update:
    """What ordinary runs said of a limb file.

    Attributes:
        changes: three a segment, in the order gain, rest angle, friction.
        error_before, error_after: (M,) root mean square open-loop error of the bend angles [rad].
        duration: of all runs [s].
        warnings: sentences.
    """

    changes: tuple[Change, ...]
    error_before: Array
    error_after: Array
    duration: float
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
    duration = sum(float(run.time[-1] - run.time[0]) for run in runs)
    if duration < LEAST_DURATION:
        raise LogError(
            f"the runs last {duration:.1f} s altogether: an update needs {LEAST_DURATION:.0f} s, "
            "and half a minute in which all segments move to tell all of it"
        )
    every = DayNumbers.of(limb)
    known = every.unknowns.prior
    try:
        remaining = BendFit(every, RodModel(limb, NODES), runs).remaining(known)
    except ConvergenceError as error:
        raise LogError(
            f"the rod of the limb '{limb.name}' cannot follow these runs: check that they are of "
            "this limb, with its mounting and what it carries"
        ) from error
    _refuse_wrong_way(runs, remaining)
    values, deviations = _solve(every, runs)
    told = replace(every, free=list(deviations))
    found = told.limb_with(values[told.free])
    before, after = (
        np.sqrt(np.nanmean(left**2, axis=0))
        for left in (remaining, BendFit(every, RodModel(limb, NODES), runs).remaining(values))
    )
    warnings = [warning for run in runs for warning in run.warnings]
    if not np.all(after < CALIBRATE_AGAIN):
        warnings.append(
            f"gain, rest angle and friction leave {math.degrees(after.max()):.1f}°: something else "
            "changed, calibrate again"
        )
    spread = every.unknowns.spread
    deviation = np.array([deviations.get(place, spread[place]) for place in every.free])
    sizes = np.array([_sizes(segment) for segment in limb.segments]).ravel()
    sized = (sizes * np.stack([known, values, spread, deviation])).T
    changes = []
    for place, numbers in zip(every.free, sized.tolist(), strict=True):
        index, kind = divmod(place, len(NUMBERS))
        changes.append(Change(index, tuple(NUMBERS)[kind], *numbers))
    found = _with_provenance(found, limb, changes, after, given)
    return found, Update(tuple(changes), before, after, duration, tuple(warnings))


def _solve(every: DayNumbers, runs: Sequence[Prepared]) -> tuple[Array, dict[int, float]]:
    """Return the best numbers (3 M,), and by place the deviations of those that the runs tell."""
    numbers, factor, deviations = every, 1.0, dict[int, float]()
    values = every.unknowns.prior
    for _ in range(MOST_PASSES):
        problem = BendFit(numbers, RodModel(every.limb, NODES), runs)
        free = problem.search.solve(values[numbers.free], factor)
        values = every.unknowns.prior.copy()
        values[numbers.free] = free
        factor = max(1.0, problem.excess(problem.remaining(free)))
        deviation = np.sqrt(np.diag(problem.search.covariance(free, factor)))
        told = deviation <= UNTOLD * numbers.unknowns.spread
        deviations = {
            p: float(d) for p, d, t in zip(numbers.free, deviation, told, strict=True) if t
        }
        if not deviations:
            return every.unknowns.prior, {}
        numbers = replace(numbers, free=list(deviations))
    return values, deviations


def _refuse_wrong_way(runs: Sequence[Prepared], remaining: Array) -> None:
    """Refuse runs in which a segment bends against its pressure.

    Args:
        runs: prepared.
        remaining: (K, M) measured less predicted bend of all runs [rad].

    Raises:
        LogError: a segment does.
    """
    ends = np.cumsum([len(run.time) for run in runs])[:-1]
    for run, left in zip(runs, np.split(remaining, ends), strict=True):
        measured = run.log.bend_angles[run.usable]
        expected = measured - left[run.usable]
        for m, (seen, told) in enumerate(zip(measured.T, expected.T, strict=True)):
            if min(np.ptp(seen), np.ptp(told)) < LEAST_MOTION:
                continue
            if np.corrcoef(seen, told)[0, 1] < WRONG_WAY:
                raise LogError(
                    f"segment {m} bends the wrong way in these runs: check that they are of this "
                    "limb, that no tubes, signs or columns are swapped, and that what it carries "
                    "is named; else calibrate again"
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
    numbers = DayNumbers.of(limb, ("gain", "rest angle"))
    unknowns = numbers.unknowns

    def missed(values: Array) -> Array:
        found = tip_of(numbers.limb_with(values))
        return np.full((int(seen.sum()), 2), np.nan) if found is None else (found - tip)[seen]

    def rows(values: Array) -> Rows:
        weight = 1.0 / (TIP_ERROR * math.sqrt(CORRELATION))
        residual, slopes = with_differences(
            lambda v: weight * missed(v).ravel(), values, _NUDGE * unknowns.spread
        )
        return residual, np.nan_to_num(slopes)

    def far(values: Array) -> float:
        return float(np.linalg.norm(missed(values), axis=1).mean())

    before = far(unknowns.prior)
    if not before >= FAR:
        return None
    found = LeastSquares(unknowns, rows).solve()
    return numbers.limb_with(found) if far(found) < BETTER * before else None


def _with_provenance(
    found: Limb,
    before: Limb,
    changes: Sequence[Change],
    error: Array,
    logs: Sequence[CalibrationLog],
) -> Limb:
    """Return the limb with a note of what the update changed and from what."""
    note = {
        "source": [log.source for log in logs],
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "changes": [change.text() for change in changes if change.told],
        "residual_deg_before": before.provenance.get("residual_deg"),
    }
    residual = [round(math.degrees(float(value)), 3) for value in error]
    provenance = {**before.provenance, "residual_deg": residual, "update": note}
    return replace(found, provenance=provenance)
