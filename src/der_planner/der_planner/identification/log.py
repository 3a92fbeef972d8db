"""The log of a calibration or of any run: as recorded, and checked on a grid that a fit can use."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.limb import Limb
from der_planner.limb.plausible import FEW, TOO_SMALL, impossible, outliers
from der_planner.model import CONTROL_PERIOD, RodModel

LONGEST_GAP = 1.0
"""Gap in the tags that a straight line may bridge [s]; rows in longer ones are not fitted to."""
LEAST_EXCITATION = 0.042
"""Standard deviation of an input below which nothing can be told of its segment, over the limit."""
LEAST_VALID = 0.5
"""Share of a log to fit to in which the tags must be seen."""
LEAST_SEEN = 0.05
"""Share of a log to predict in which the tags must be seen."""
SWING = np.deg2rad(0.5)
"""Amplitude below which a swing need not be waited for [rad]."""
LONGEST_PERIOD = 5.0
"""Median time between two rows above which the time must have another unit [s]."""
LEAST_DURATION, LONGEST_DURATION = 1.0, 1e4
"""Durations below and above which it must, too [s]."""
LEAST_MOTION = np.deg2rad(3.0)
"""Range of motion from which on gains are judged [rad]."""
TOO_LARGE = 3.0
"""Largest differential pressure, over the prior's limit, that is not taken for another unit."""
ANOTHER_SIDE = math.radians(25.0)
"""Direction of the tips beside that of the bend angles above which their axes differ [rad]."""
OTHER_CLOCKS = 3.0, 0.6, 0.25
"""Clocks may differ by up to so much [s]; they do, by this or more, if it leaves this share of the
squares that pressures do not explain. Friction and slow air leave twice as much."""
LONGEST_REPEATED = 0.5
"""Time for which a limb that is driven may show the very same numbers [s]."""
LONGEST_SWING = 12.0
"""Longest time at the beginning of a log that is waited for a swing to end [s]."""


class LogError(ValueError):
    """A log cannot be used; the message names what is missing and the remedy."""


@dataclass(frozen=True)
class CalibrationLog:
    """One run on one time axis. Missing numbers are NaN.

    Attributes:
        time: (K,) rising [s].
        commanded_differential: (K, M) [Pa].
        measured_differential: (K, M) [Pa].
        bend_angles: (K, M) [rad], as the tracker measures them.
        tip: (K, 2) [m]; all NaN where a log has no scale.
        source: where it came from, for provenance.
    """

    time: Array
    commanded_differential: Array
    measured_differential: Array
    bend_angles: Array
    tip: Array
    source: str = ""

    def __post_init__(self) -> None:
        tables = ("commanded_differential", "measured_differential", "bend_angles", "tip")
        for name in ("time", *tables):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        rows = self.time.shape
        if self.time.ndim != 1 or self.time.size < 2:
            raise LogError(f"a log needs two instants or more, time has shape {rows}")
        falls = np.flatnonzero(~(np.diff(self.time) > 0))
        if falls.size:
            before, after = self.time[falls[0] : falls[0] + 2]
            raise LogError(
                f"the time of {self.source or 'a log'} falls from {before:.6g} s to {after:.6g} s: "
                "is it more than one run, or has a clock been set? Keep one run a table"
            )
        inputs = self.commanded_differential.shape[-1:]
        for name in tables:
            found, expected = getattr(self, name).shape, rows + (inputs if name != "tip" else (2,))
            if found != expected:
                raise LogError(f"{name} has shape {found}, expected {expected}")

    @property
    def segment_count(self) -> int:
        """M."""
        return int(self.bend_angles.shape[1])

    def resampled(self, period: float, longest_gap: float = LONGEST_GAP) -> CalibrationLog:
        """Return the log on a regular grid, NaN in gaps longer than ``longest_gap`` [s].

        Args:
            period: of the grid [s].
            longest_gap: between two valid rows of a column that a straight line may bridge [s].
        """
        grid = np.arange(self.time[0], self.time[-1] + 1e-9, period)
        return self._of(grid, lambda table: on_grid(self.time, table, grid, longest_gap))

    def between(self, first: float, last: float) -> CalibrationLog:
        """Return the rows from ``first`` to ``last`` [s]."""
        rows = (self.time >= first) & (self.time <= last)
        return self._of(self.time[rows], lambda values: values[rows])

    def parted(self, share: float) -> tuple[CalibrationLog, CalibrationLog]:
        """Return the log without its last part, and that part; ``share`` is that of its time."""
        edge = self.time[-1] - share * (self.time[-1] - self.time[0])
        after = float(np.nextafter(edge, np.inf))
        return self.between(self.time[0], edge), self.between(after, self.time[-1])

    def seen_earlier(self, seconds: float, longest_gap: float = LONGEST_GAP) -> CalibrationLog:
        """Return the log with what was seen put to instants that are earlier by some seconds."""
        seen, earlier = (self.bend_angles, self.tip), self.time - seconds
        angles, tip = (on_grid(earlier, table, self.time, longest_gap) for table in seen)
        return replace(self, bend_angles=angles, tip=tip)

    def _of(self, time: Array, table: Callable[[Array], Array]) -> CalibrationLog:
        """Return the log at other instants, its tables changed by a function."""
        commanded, measured = table(self.commanded_differential), table(self.measured_differential)
        angles, tip = table(self.bend_angles), table(self.tip)
        return CalibrationLog(time, commanded, measured, angles, tip, self.source)


def on_grid(time: Array, table: Array, grid: Array, longest_gap: float) -> Array:
    """Return a table (G, N) on a regular grid, by straight lines between known rows of a column.

    Args:
        time: (K,) rising [s].
        table: (K, N), NaN where nothing is known.
        grid: (G,) regular instants [s].
        longest_gap: between two known rows that a line may bridge [s]; a row of the grid in a
            longer one is NaN, unless it is nearer to a known row than the grid's period.
    """
    result = np.full((grid.size, table.shape[1]), np.nan)
    period = grid[1] - grid[0] if grid.size > 1 else 0.0
    for column, found in zip(table.T, result.T, strict=True):
        known = np.isfinite(column)
        if not known.any():
            continue
        instants = time[known]
        found[:] = np.interp(grid, instants, column[known])
        after = instants[np.clip(np.searchsorted(instants, grid, "left"), 0, len(instants) - 1)]
        before = instants[np.clip(np.searchsorted(instants, grid, "right") - 1, 0, None)]
        edge = np.minimum(np.abs(after - grid), np.abs(before - grid))
        found[(after - before > longest_gap) & (edge > period)] = np.nan
        found[(grid < instants[0] - period) | (grid > instants[-1] + period)] = np.nan
    return result


def bridge(table: Array) -> Array:
    """Return a table (K, N) whose missing rows are straight lines between the known ones."""
    index = np.arange(len(table))
    known = np.isfinite(table)
    return np.stack(
        [np.interp(index, index[k], c[k]) for c, k in zip(table.T, known.T, strict=True)], axis=1
    )


@dataclass(frozen=True)
class Prepared:
    """A log on a regular grid.

    Attributes:
        log: on the grid, NaN where nothing was measured.
        pressure: (K, M) measured, without gaps [Pa].
        bend: (K, M) bend angles without gaps [rad].
        usable: (K,) rows to fit to.
        warnings: sentences for the report.
        swings: whether friction is loosened by the measured swings, or as in a prediction by none.
    """

    log: CalibrationLog
    pressure: Array
    bend: Array
    usable: NDArray[np.bool_]
    warnings: tuple[str, ...]
    swings: bool = True

    def without(self, rows: NDArray[np.bool_]) -> Prepared:
        """Return the log with rows (K,) more that are not fitted to."""
        missing = np.where(rows, np.nan, 0.0)[:, None]
        angles, tip = self.log.bend_angles + missing, self.log.tip + missing
        log = replace(self.log, bend_angles=angles, tip=tip)
        return replace(self, log=log, usable=self.usable & ~rows)


def prepare(
    log: CalibrationLog, limb: Limb, longest_gap: float = LONGEST_GAP, *, to_fit: bool = True
) -> Prepared:
    """Resample a log to the control period and check it.

    Args:
        log: as recorded.
        limb: that it should belong to.
        longest_gap: between two rows that a straight line may bridge [s].
        to_fit: the log must tell every parameter; a run that is only predicted need not move every
            segment.

    Raises:
        LogError: another number of segments, too few tags or no pressures; with ``to_fit`` an input
            without excitation as well, or pressures that contradict the commands or the bends (a
            wrong column map).
    """
    if log.segment_count != limb.segment_count:
        raise LogError(
            f"the log has {log.segment_count} segments, the limb '{limb.name}' "
            f"{limb.segment_count}: this limb file belongs to another limb"
        )
    _check_time(log)
    warnings: list[str] = []
    grid = _without_outliers(log, limb, warnings).resampled(CONTROL_PERIOD, longest_gap)
    valid = np.all(np.isfinite(grid.bend_angles), axis=1)
    least = LEAST_VALID if to_fit else LEAST_SEEN
    if valid.mean() < least:
        raise LogError(
            f"the tags were seen in {100 * valid.mean():.0f} % of the log only, "
            f"{100 * least:.0f} % are needed: check light, focus and the tag map; rows more than "
            f"{longest_gap:g} s apart leave a gap (--longest-gap)"
        )
    if valid.mean() < 0.98:
        warnings.append(f"tags lost in {100 * (1 - valid.mean()):.1f} % of the log")
    for index, share in enumerate(np.isfinite(grid.measured_differential).mean(axis=0)):
        if share < least:
            raise LogError(
                f"pressure {index} was measured in {100 * share:.0f} % of the log only: the fit "
                "needs the board's telemetry"
            )
    pressure, bend = bridge(grid.measured_differential), bridge(grid.bend_angles)
    swinging = _still_swinging(grid.time, pressure, bend, limb)
    _check_scale(pressure, bend, limb)
    if to_fit:
        _check_tips(grid, limb)
        least_excitation = LEAST_EXCITATION * limb.pneumatics.pressure_limit
        _check_commands(grid, least_excitation)
        _check_excitation(pressure[valid & ~swinging], least_excitation)
        _check_match(pressure, bend, warnings)
        _check_clocks(pressure, bend, warnings)
        _check_axes(grid, limb)
    if swinging.any():
        grid.bend_angles[swinging], grid.tip[swinging] = np.nan, np.nan
        warnings.append(
            "the log begins while the limb swings: its first "
            f"{CONTROL_PERIOD * swinging.sum():.1f} s are not used, since no pressure tells that "
            "motion"
        )
    return Prepared(grid, pressure, bend, valid & ~swinging, tuple(warnings), swings=to_fit)


def _still_swinging(time: Array, pressure: Array, bend: Array, limb: Limb) -> NDArray[np.bool_]:
    """Return the rows (K,) in which the limb swings from before the log, at most a fifth of all.

    In the first second, motion beyond what the pressures explain is taken for a swing, which then
    decays with the prior's damping.
    """
    elapsed = time - time[0]
    first = elapsed < 1.0
    driven = limb.static_gain * np.ptp(pressure[first], axis=0)
    amplitude = 0.5 * float(np.max(np.ptp(bend[first], axis=0) - 2.0 * driven))
    if amplitude < 2.0 * SWING:
        return np.zeros(len(elapsed), dtype=bool)
    decay = 0.5 * max(float(np.mean([s.damping for s in limb.segments])), 0.2)
    swing = min(float(np.log(amplitude / SWING)) / decay, LONGEST_SWING, 0.2 * elapsed[-1])
    return np.asarray(elapsed < swing)


def _check_time(log: CalibrationLog) -> None:
    """Refuse a log whose time is not in seconds."""
    period, duration = float(np.median(np.diff(log.time))), float(np.ptp(log.time))
    if period > LONGEST_PERIOD or not LEAST_DURATION <= duration <= LONGEST_DURATION:
        raise LogError(
            f"the log lasts {duration:.3g} s, with a row every {period:.3g} s: give the time in "
            "seconds, or name its unit in columns.yaml (time_unit)"
        )


def _without_outliers(log: CalibrationLog, limb: Limb, warnings: list[str]) -> CalibrationLog:
    """Return the log without single numbers that no such limb shows."""
    far = impossible(limb, "tips", log.tip)
    wrong = {
        "pressures": outliers(limb, "pressures", log.measured_differential, LogError),
        "bend angles": outliers(limb, "bend angles", log.bend_angles, LogError),
        "tips": far & (far.mean() <= FEW),  # `_check_tips` refuses many
    }
    for what, rows in wrong.items():
        if rows.any():
            warnings.append(f"{rows.sum()} rows have {what} that no such limb has: left out")
    frozen = _repeated(log, LEAST_EXCITATION * limb.pneumatics.pressure_limit)
    if frozen.any():
        warnings.append(
            f"{frozen.sum()} rows repeat the bend angles of the row before while pressures change, "
            "as where tags are lost: left out"
        )
        wrong["bend angles"], wrong["tips"] = wrong["bend angles"] | frozen, wrong["tips"] | frozen
    pairs = zip(wrong.values(), (log.measured_differential, log.bend_angles, log.tip), strict=True)
    pressures, bends, tips = (np.where(rows[:, None], np.nan, table) for rows, table in pairs)
    return replace(log, measured_differential=pressures, bend_angles=bends, tip=tips)


def _repeated(log: CalibrationLog, least: float) -> NDArray[np.bool_]:
    """Return the rows (K,) in which bend angles stand still though pressures change.

    Args:
        log: of a driven limb.
        least: change of the pressures since the first of such rows [Pa].
    """
    same = np.append(False, np.all(np.diff(log.bend_angles, axis=0) == 0.0, axis=1))
    first = np.maximum.accumulate(np.where(same, 0, np.arange(len(same))))
    moved = np.abs(log.measured_differential - log.measured_differential[first]).max(axis=1)
    counts = same & (log.time - log.time[first] > LONGEST_REPEATED) & (moved > least)
    return np.asarray(same & np.isin(first, first[counts]))


def _check_tips(log: CalibrationLog, limb: Limb) -> None:
    """Refuse tips that are nowhere near the limb: another unit, or another origin."""
    away = np.linalg.norm(log.tip, axis=1)
    if not np.isfinite(away).any():
        return
    far = float(np.nanpercentile(away, 90))
    if not 0.5 * limb.length < far < 1.5 * limb.length:
        raise LogError(
            f"the tips are {far:.3g} m from the clamp, the limb '{limb.name}' is "
            f"{limb.length:.3g} m long: check the tips' unit (length_unit) and origin, which is "
            "the clamp, or give the limb's lengths in the limb file of --prior"
        )


def _check_axes(log: CalibrationLog, limb: Limb) -> None:
    """Refuse tips that are elsewhere than the bend angles put them: swapped or turned axes."""
    bent = RodModel(limb).kinematics.tip(log.bend_angles)
    aside = np.arctan2(bent[:, 1], bent[:, 0]) - np.arctan2(log.tip[:, 1], log.tip[:, 0])
    turned = np.abs(np.arctan2(np.sin(aside), np.cos(aside)))[np.isfinite(aside)]
    apart = float(np.percentile(turned, 90)) if turned.size else 0.0
    if apart > ANOTHER_SIDE:
        raise LogError(
            f"the tips are {math.degrees(apart):.0f}° aside, seen from the clamp, of where the "
            "bend angles put them: x points along the straight limb, and y to the side to which "
            "positive angles turn; check the order of the columns tip, and the angles' factor"
        )


def _check_commands(log: CalibrationLog, least: float) -> None:
    columns = zip(log.commanded_differential.T, log.measured_differential.T, strict=True)
    for index, (command, measured) in enumerate(columns):
        both = np.isfinite(command) & np.isfinite(measured)
        if both.sum() < 10 or min(np.std(command[both]), np.std(measured[both])) < least:
            continue
        agreement = float(np.corrcoef(command[both], measured[both])[0, 1])
        if agreement < 0.3:
            raise LogError(
                f"measured pressure {index} does not follow its command (correlation "
                f"{agreement:.2f}): check the column map and the tubes"
            )


def _check_scale(pressure: Array, bend: Array, limb: Limb) -> None:
    """Refuse pressures that are far too small for the bends that they go with, or too large."""
    largest, limit = float(np.nanmax(np.abs(pressure))), limb.pneumatics.pressure_limit
    if largest > TOO_LARGE * limit:
        raise LogError(
            f"pressures differ by up to {largest:.3g} Pa, the prior's limit is {limit:.0f} Pa: "
            "name their unit in columns.yaml (pressure_unit), or give your limb's limit in --prior"
        )
    driven = float((limb.static_gain * np.ptp(pressure, axis=0)).max())
    moved = float(np.ptp(bend, axis=0).max())
    if moved > LEAST_MOTION and driven < TOO_SMALL * moved:
        raise LogError(
            f"segments bend by {np.degrees(moved):.0f}° while their pressures change by "
            f"{np.ptp(pressure, axis=0).max():.3g} Pa: name their unit in columns.yaml "
            "(pressure_unit), and check that nobody moves the limb"
        )


def _check_excitation(pressure: Array, least: float) -> None:
    for index, value in enumerate(np.std(pressure, axis=0)):
        if value < least:
            raise LogError(
                f"input {index} was not excited (standard deviation {value:.0f} Pa, "
                f"{least:.0f} Pa needed): nothing can be told of segment {index}; "
                "run the calibration motion, or name their unit in columns.yaml (pressure_unit)"
            )


def _check_match(pressure: Array, bend: Array, warnings: list[str]) -> None:
    """Refuse segments that follow another one's pressure, or their own with the wrong sign."""
    count = pressure.shape[1]
    design = np.concatenate([pressure, np.ones((len(pressure), 1))], axis=1)
    gains = np.linalg.lstsq(design, bend, rcond=None)[0][:count].T
    if count > 1 and np.abs(np.corrcoef(pressure.T) - np.eye(count)).max() > 0.98:
        warnings.append(
            "inputs always move together: swapped columns and coupling between segments cannot be "
            "told"
        )
        pairs = zip(pressure.T, bend.T, strict=True)
        gains = np.diag([np.polyfit(own, angle, 1)[0] for own, angle in pairs])
    for index, row in enumerate(gains):
        most = int(np.argmax(np.abs(row)))
        if abs(row[most]) > 1.5 * abs(row[index]):
            raise LogError(
                f"segment {index} bends with input {most}, not with input {index}: columns or "
                "tubes are swapped, or angles and pressures have two clocks"
            )
        if row[index] < 0:
            raise LogError(
                f"segment {index} bends the wrong way: positive differential pressure must bend "
                "toward +y; swap the two chambers or the sign in the column map"
            )


def _check_clocks(pressure: Array, bend: Array, warnings: list[str]) -> None:
    """Warn of bends that go with the pressures of another time."""
    farthest, least, share = OTHER_CLOCKS
    reach = round(farthest / CONTROL_PERIOD)
    inner, ones, left = bend[reach:-reach], np.ones((len(pressure), 1)), {}
    for shift in range(-reach, reach + 1, 5):
        design = np.hstack([np.roll(pressure, shift, axis=0), ones])[reach:-reach]
        left[shift] = float(np.linalg.lstsq(design, inner, rcond=None)[1].sum())
    best = min(left, key=left.__getitem__)
    late = best * CONTROL_PERIOD
    if abs(late) >= least and left[best] < share * left[0]:
        warnings.append(
            f"bends go with the pressures {abs(late):.2f} s {'before' if late > 0 else 'after'} "
            "them: put times of both on one clock in the log (of motion capture: poses_late), or "
            "the limb's numbers are wrong"
        )
