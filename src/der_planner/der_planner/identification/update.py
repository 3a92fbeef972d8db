"""Gain, rest angle and friction of a limb file, brought up to date from ordinary runs.

A calibration moves every chamber on purpose. An ordinary run tells less, so that only what changes
from day to day is asked of it, and what is known of it before, the limb file with the spread of
days around it, is weighed against the run:

    minimise  Σ (measured − predicted bend)² / (e² ℓ)  +  Σ x²

with x an unknown's distance from the limb file in spreads of a day (`GAIN_SPREAD` …), e the error
that remains and ℓ the number of rows over which it stays alike, both taken from the fit before (at
least 0.3° and 1 s: what a model of this kind leaves anyhow). The prediction is open loop from the
measured pressures. An unknown whose standard deviation stays that of the days was not told by the
run, and keeps its value.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.check import LEAST_MOTION
from der_planner.identification.logs.log import CalibrationLog, LogError
from der_planner.identification.logs.prepare import Prepared, prepare
from der_planner.identification.problem import (
    ANGLE_ERROR,
    CORRELATION,
    NOT_FOLLOWED,
    UNTOLD,
    correlation_length,
)
from der_planner.identification.report import CALIBRATE_AGAIN, Change, Update
from der_planner.identification.rod_angles import NODES
from der_planner.limb import Limb, Segment
from der_planner.limb.days import GAIN_SPREAD, LARGEST_CHANGES, REST_SPREAD, on_another_day
from der_planner.model import RodModel, simulate
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]

FRICTION_SPREAD = 0.5
"""Of friction, as a share of it …"""
LEAST_FRICTION_SPREAD = 100.0
"""… and at least this, as a pressure [Pa]."""
FRICTION_ANGLE = 0.1
"""Bend over which friction turns round, for a limb file without friction [rad]."""
WRONG_WAY = -0.5
"""Correlation of predicted and measured bend below which pressure and bend have other signs."""
LEAST_DURATION = 5.0
"""Of all runs together [s]."""
_LARGEST_FRICTION_CHANGE = 20.0
"""In spreads of a day."""
_PASSES = 3
_STEP = 1e-3
"""Of an unknown in its spread, for a difference of two predictions."""
_CHECK_LIMB = (
    "check that they are of this limb, that no tubes, signs or columns are swapped, and that what "
    "it carries is named"
)
_NOT_FOLLOWED = (
    "the rod of the limb '{name}' cannot follow these runs: check that they are of this limb, with "
    "its mounting and what it carries"
)
_NAMES = ("gain", "rest angle", "friction")
_GAIN, _REST, _FRICTION = range(3)


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
    duration = sum(float(run.log.time[-1] - run.log.time[0]) for run in runs)
    if duration < LEAST_DURATION:
        raise LogError(
            f"the runs last {duration:.1f} s altogether: an update needs {LEAST_DURATION:.0f} s, "
            "and half a minute in which all segments move to tell all of it"
        )
    days = _Days(limb, runs)
    days.refuse_wrong_way()
    x, deviation, told = days.solve()
    before, after = days.error(np.zeros_like(x)), days.error(x)
    warnings = [warning for run in runs for warning in run.warnings]
    if not np.all(after < CALIBRATE_AGAIN):
        warnings.append(
            f"gain, rest angle and friction leave {math.degrees(after.max()):.1f}°: something else "
            "changed, calibrate again"
        )
    changes = tuple(
        change for m in range(limb.segment_count) for change in days.changes(m, x, deviation, told)
    )
    found = _with_provenance(days.limb(x), limb, changes, after, given)
    return found, Update(changes, before, after, duration, tuple(warnings))


class _Days:
    """The unknowns of a limb file that change from day to day, in spreads of a day.

    Args:
        limb: as its file says.
        runs: prepared logs.
    """

    def __init__(self, limb: Limb, runs: list[Prepared]) -> None:
        self._limb, self._runs = limb, runs
        self._size = 3 * limb.segment_count
        self._weight = 1.0 / (ANGLE_ERROR * math.sqrt(CORRELATION))
        self._last: tuple[bytes, list[Array] | None] | None = None
        largest = [*LARGEST_CHANGES, _LARGEST_FRICTION_CHANGE]
        self._high = np.tile(largest, limb.segment_count)
        self._low = -self._high
        # Friction is never negative.
        for m, segment in enumerate(limb.segments):
            self._low[3 * m + _FRICTION] = -segment.friction_moment / _friction_spread(segment)

    def limb(self, x: Array) -> Limb:
        """Return the limb with the unknowns (3 M,)."""
        arcs = self._limb.pcc_segments
        return replace(
            self._limb,
            segments=tuple(_moved(s, row) for s, row in self._rows(self._limb.segments, x)),
            pcc_segments=tuple(_moved(s, row) for s, row in self._rows(arcs, x)) if arcs else (),
        )

    def _rows(self, segments: Sequence[Segment], x: Array) -> list[tuple[Segment, Array]]:
        return list(zip(segments, x.reshape(-1, 3), strict=True))

    def refuse_wrong_way(self) -> None:
        """Refuse runs in which a segment bends against its pressure.

        Raises:
            LogError: it does, or the rod cannot follow the runs.
        """
        expected, seen = np.zeros((0, self._limb.segment_count)), []
        predicted = self._followed(np.zeros(self._size))
        for run, part in zip(self._runs, predicted, strict=True):
            rows = run.usable
            expected = np.concatenate([expected, part[rows] - part[rows].mean(axis=0)])
            seen.append(run.log.bend_angles[rows] - run.log.bend_angles[rows].mean(axis=0))
        measured = np.concatenate(seen)
        for m in range(self._limb.segment_count):
            if np.ptp(expected[:, m]) < LEAST_MOTION or np.ptp(measured[:, m]) < LEAST_MOTION:
                continue
            if np.corrcoef(expected[:, m], measured[:, m])[0, 1] < WRONG_WAY:
                raise LogError(
                    f"segment {m} bends the wrong way in these runs: {_CHECK_LIMB}; else "
                    "calibrate again"
                )

    def solve(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return the unknowns, their standard deviations and which the runs tell, (3 M,) each.

        Raises:
            LogError: the rod cannot follow the runs.
        """
        told = np.ones(self._size, dtype=bool)
        x, deviation = np.zeros(self._size), np.ones(self._size)
        self._followed(x)
        for _ in range(_PASSES):
            x = self._fit(x, told)
            self._believe_remaining(x)
            deviation = self._deviation(x, told)
            if np.any(deviation[told] > UNTOLD):
                told &= deviation <= UNTOLD
                x = self._fit(np.where(told, x, 0.0), told)
        return np.where(told, x, 0.0), np.where(told, deviation, 1.0), told

    def _fit(self, x: Array, told: NDArray[np.bool_]) -> Array:
        if not told.any():
            return x
        rows = sum(run.log.bend_angles.size for run in self._runs)

        def full(part: Array) -> Array:
            whole = np.zeros(self._size)
            whole[told] = part
            return whole

        def residual(part: Array) -> Array:
            remaining = self._remaining(full(part))
            if remaining is None:
                remaining = np.full(rows, NOT_FOLLOWED)
            return np.concatenate([self._weight * remaining, part])

        def jacobian(part: Array) -> Array:
            slopes = self._slopes(full(part), told)
            return np.concatenate([self._weight * slopes, np.eye(len(part))])

        low, high = self._low[told] - 1e-9, self._high[told] + 1e-9
        found = least_squares(
            residual, x[told], jac=jacobian, bounds=(low, high), xtol=1e-3, ftol=1e-4, max_nfev=20
        )
        return full(np.clip(found.x, self._low[told], self._high[told]))

    def _believe_remaining(self, x: Array) -> None:
        """Weigh the rows by the error that remains, and by how long it stays alike."""
        length, remaining = CORRELATION, []
        for run, part in zip(self._runs, self._followed(x), strict=True):
            error = np.where(run.usable[:, None], run.log.bend_angles - part, np.nan)
            length = max(length, correlation_length(error))
            remaining.append(error)
        error_rms = float(np.sqrt(np.nanmean(np.concatenate(remaining) ** 2)))
        self._weight = 1.0 / (max(error_rms, ANGLE_ERROR) * math.sqrt(length))

    def _deviation(self, x: Array, told: NDArray[np.bool_]) -> Array:
        slopes = self._weight * self._slopes(x, told)
        information = slopes.T @ slopes + np.eye(int(told.sum()))
        deviation = np.ones(self._size)
        deviation[told] = np.sqrt(np.diag(np.linalg.inv(information)))
        return deviation

    def error(self, x: Array) -> Array:
        """Return the root mean square error of the bend angles (M,) [rad]."""
        squares = [
            (run.log.bend_angles - part)[run.usable] ** 2
            for run, part in zip(self._runs, self._followed(x), strict=True)
        ]
        error: Array = np.sqrt(np.nanmean(np.concatenate(squares), axis=0))
        return error

    def _remaining(self, x: Array) -> Array | None:
        """Return predicted less measured angles of all runs, 0 where unseen; None: not followed."""
        angles = self._angles(x)
        if angles is None:
            return None
        parts = [
            np.where(run.usable[:, None], part - run.log.bend_angles, 0.0).ravel()
            for run, part in zip(self._runs, angles, strict=True)
        ]
        return np.concatenate(parts)

    def _slopes(self, x: Array, told: NDArray[np.bool_]) -> Array:
        """Return ∂(remaining)/∂(unknowns that are told), by differences."""
        here = self._remaining(x)
        rows = sum(run.log.bend_angles.size for run in self._runs)
        columns = []
        for place in np.flatnonzero(told):
            step = _STEP if x[place] + _STEP < self._high[place] else -_STEP
            moved = x.copy()
            moved[place] += step
            there = self._remaining(moved)
            if here is None or there is None:
                columns.append(np.zeros(rows))
            else:
                columns.append((there - here) / step)
        return np.stack(columns, axis=1) if columns else np.zeros((rows, 0))

    def _angles(self, x: Array) -> list[Array] | None:
        """Return the predicted bend angles (K, M) [rad] of each run; None: not followed.

        The last ones are kept: errors and slopes are asked for at the same unknowns.
        """
        key = x.tobytes()
        if self._last is None or self._last[0] != key:
            self._last = (key, self._predicted(x))
        return self._last[1]

    def _predicted(self, x: Array) -> list[Array] | None:
        model = RodModel(self.limb(x), NODES)
        try:
            angles = [
                simulate(model, run.log.time, pressures=run.pressure, steps=1).bend_angles
                for run in self._runs
            ]
        except ConvergenceError:
            return None
        return angles if all(np.isfinite(part).all() for part in angles) else None

    def _followed(self, x: Array) -> list[Array]:
        """Return the angles where the rod was seen to follow.

        Raises:
            LogError: it does not.
        """
        angles = self._angles(x)
        if angles is None:
            raise LogError(_NOT_FOLLOWED.format(name=self._limb.name))
        return angles

    def changes(
        self, m: int, x: Array, deviation: Array, told: NDArray[np.bool_]
    ) -> tuple[Change, ...]:
        """Return the changes of a segment's three numbers."""
        old = self._limb.segments[m]
        new = _moved(old, x[3 * m : 3 * m + 3])
        spreads = (GAIN_SPREAD * old.static_gain, REST_SPREAD, _friction_spread(old))
        # That of a gain is a share of the gain, which is another one now.
        units = (GAIN_SPREAD * new.static_gain, *spreads[1:])
        columns = (_NAMES, _day(old), _day(new), spreads, units)
        return tuple(
            Change(
                m, name, before, after, spread,
                unit * float(deviation[3 * m + n]), bool(told[3 * m + n]),
            )
            for n, (name, before, after, spread, unit) in enumerate(zip(*columns, strict=True))
        )  # fmt: skip


def _day(segment: Segment) -> tuple[float, float, float]:
    """Return gain [rad/Pa], rest angle [rad] and friction [N·m]."""
    return segment.static_gain, segment.rest_curvature * segment.length, segment.friction_moment


def _friction_spread(segment: Segment) -> float:
    """Return the spread of a segment's friction from day to day [N·m]."""
    least = LEAST_FRICTION_SPREAD * segment.moment_gain
    return max(FRICTION_SPREAD * segment.friction_moment, least)


def _moved(segment: Segment, row: Array) -> Segment:
    """Return a segment with its three unknowns put in place; what does not move stays as it is."""
    changed = {}
    if row[_FRICTION]:
        moment = segment.friction_moment + _friction_spread(segment) * row[_FRICTION]
        changed["friction_moment"] = max(0.0, float(moment))
        if not segment.friction_curvature:
            changed["friction_curvature"] = FRICTION_ANGLE / segment.length
    return replace(on_another_day(segment, row[_GAIN], row[_REST]), **changed)


def _with_provenance(
    found: Limb,
    before: Limb,
    changes: tuple[Change, ...],
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
