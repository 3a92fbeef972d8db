"""Paths of the tip: read, checked, timed within stated limits, resampled; shapes that it draws."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator, make_interp_spline

from der_planner.arrays import Array, interpolate
from der_planner.model.bending import Kinematics
from der_planner.planning.loads import PlanningError
from der_planner.planning.timing import LONGEST, PathLimits, paced, smooth_step, tip_rates

CURVES: dict[str, Callable[[Array], tuple[Array, Array]]] = {
    "circle": lambda phase: (np.cos(phase), np.sin(phase)),
    "figure_eight": lambda phase: (np.sin(2 * phase) / 2, np.sin(phase)),
}
"""Smooth shapes: x and y over the radius at phases of a cycle [rad]."""
_STAR = 2 * np.pi * np.arange(6) * 2 / 5
POLYGONS = {
    "line": np.array([(0.0, -1.0), (0.0, 1.0), (0.0, -1.0)]),
    "star": np.column_stack([np.cos(_STAR), np.sin(_STAR)]),
}
"""Shapes of straight lines: their corners over the radius."""
SHAPES = (*CURVES, *POLYGONS)
"""Shapes that the tip can draw."""
SHAPE_SIZE = 0.04
"""Radius (half length) of a shape over the limb's length, at an amplitude of 45 degrees."""
_SHAPE_POINTS = 50
"""A quarter of the points of a shape in one cycle."""


@dataclass(frozen=True)
class TipPath:
    """A timed path of the tip.

    Attributes:
        time: (P,) increasing, from 0 [s].
        tip: (P, 2) [m].
        exact: take straight lines between the points (polygons) instead of a smooth curve.
    """

    time: Array
    tip: Array
    exact: bool = False

    @classmethod
    def build(
        cls, time: ArrayLike | None, tip: ArrayLike, limits: PathLimits | None = None
    ) -> TipPath:
        """Check a path, and time it if it has no times.

        Raises:
            PlanningError: what was expected and what came.
        """
        points = checked_points(tip)
        if time is None:
            return time_path(points, limits or PathLimits())
        instants = np.asarray(time, dtype=float)
        if instants.shape != (len(points),):
            raise PlanningError(
                f"a tip path of {len(points)} points needs as many times, "
                f"got shape {instants.shape}"
            )
        steps = np.diff(instants)
        if not np.all(np.isfinite(instants)) or np.any(steps <= 0):
            row = int(np.argmax(~(steps > 0))) + 1
            raise PlanningError(
                f"times of a tip path must increase: point {row} is at {instants[row]} s, "
                f"the one before at {instants[row - 1]} s"
            )
        if instants[-1] - instants[0] > LONGEST:
            raise PlanningError(
                f"the tip path lasts {instants[-1] - instants[0]:.0f} s, "
                f"the longest is {LONGEST:.0f} s"
            )
        return cls(instants - instants[0], points)

    @property
    def duration(self) -> float:
        """From the first to the last point [s]."""
        return float(self.time[-1])

    def check_unit(self, length: float) -> None:
        """Refuse a path that is as far away from a limb of a length [m] as other units make it."""
        farthest = float(np.abs(self.tip).max())
        if farthest > 3.0 * length:
            raise PlanningError(
                f"points are in metres: {farthest:.4g} is {farthest / length:.0f} lengths of the "
                "limb; millimetres are divided by 1000 (a file names them: x [mm])"
            )

    def resample(self, step: float) -> tuple[Array, Array]:
        """Return instants about ``step`` apart and the points (K, 2) there."""
        instants = np.linspace(0.0, self.duration, max(8, round(self.duration / step) + 1))
        if self.exact or len(self.time) < 4:
            points = interpolate(instants, self.time, self.tip)
        elif np.any(np.all(np.diff(self.tip, axis=0) == 0.0, axis=1)):
            # A spline would swing about the point where the tip is to wait.
            points = PchipInterpolator(self.time, self.tip)(instants)
        else:
            points = make_interp_spline(self.time, self.tip, k=3)(instants)
        return instants, points


def checked_points(tip: ArrayLike) -> Array:
    """Return the points of a path as (P, 2) numbers [m].

    Raises:
        PlanningError: another shape, too few points, or one that is not finite.
    """
    points = np.asarray(tip, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise PlanningError(
            f"a tip path needs two or more points as (P, 2) numbers in m, got shape {points.shape}"
        )
    if not np.all(np.isfinite(points)):
        row = int(np.argmax(~np.isfinite(points).all(axis=1)))
        raise PlanningError(f"point {row} of the tip path is not finite: {points[row]}")
    return points


def time_path(points: Array, limits: PathLimits) -> TipPath:
    """Time a path: rest at both ends, no faster than the limits along and across it.

    The curve is a spline over its chord length.

    Raises:
        PlanningError: limits that are not positive, or a path of no length.
    """
    if not (limits.speed > 0 and limits.acceleration > 0):
        raise PlanningError(f"speed and acceleration limits must be positive, got {limits}")
    chords = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.append(True, chords > 1e-9)]
    if len(points) < 2:
        raise PlanningError("all points of the tip path coincide: it has no length")
    chord = np.append(0.0, np.cumsum(chords[chords > 1e-9]))
    spline = make_interp_spline(chord, points, k=min(3, len(points) - 1))
    place = np.linspace(0.0, chord[-1], int(np.clip(chord[-1] / 2e-4, 200, 20000)))
    instants, along = paced(place, *tip_rates(spline(place), place, limits), rest=True)
    return TipPath(instants, spline(along))


def polygon(corners: Array, period: float) -> TipPath:
    """Return the timed path along straight lines that rests at every corner.

    Each side takes a share of the period in proportion to its length, with a quintic from rest to
    rest.
    """
    lengths = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    shares = lengths / lengths.sum() * period
    times, points = [np.zeros(1)], [corners[:1]]
    start = 0.0
    for corner, following, share in zip(corners[:-1], corners[1:], shares, strict=True):
        local = np.linspace(0.0, 1.0, max(10, round(share / 0.02)) + 1)[1:]
        times.append(start + share * local)
        points.append(corner + smooth_step(local)[:, None] * (following - corner))
        start += share
    return TipPath(np.concatenate(times), np.concatenate(points), exact=True)


def draw_shape(
    name: str,
    kinematics: Kinematics,
    amplitude: float,
    period: float,
    cycles: int,
    from_bend: Array,
) -> TipPath:
    """Return a shape as a timed path around the tip of a limb bent by 1.2 times the amplitude.

    Curves start and end at rest by a fade of their phase over the first and last quarter of a
    period; polygons rest at each corner.

    Args:
        name: one of `SHAPES`.
        kinematics: of the arcs.
        amplitude: bend angle that sets place and size [rad].
        period: of one cycle [s].
        cycles: how many.
        from_bend: (M,) bend angles from which the amplitude counts [rad].
    """
    bend = from_bend + 1.2 * amplitude
    centre = kinematics.tip(bend)
    length = float(kinematics.tip(np.zeros_like(bend))[0])
    radius = SHAPE_SIZE * length * amplitude / (np.pi / 4)
    heading = float(bend.sum()) / 2
    along = np.array([np.cos(heading), np.sin(heading)])
    axes = radius * np.array([along, [-along[1], along[0]]])
    if name in POLYGONS:
        corners = centre + POLYGONS[name] @ axes
        return polygon(np.concatenate([corners] + [corners[1:]] * (cycles - 1)), period * cycles)
    total = period * cycles
    time = np.linspace(0.0, total + period / 4, _SHAPE_POINTS * 4 * cycles + 1)
    phase = 2 * np.pi * _faded_phase(time / period, cycles)
    return TipPath(time, centre + np.column_stack(CURVES[name](phase)) @ axes)


def _faded_phase(turns: Array, cycles: int) -> Array:
    """Return the phase in turns: rate from 0 to 1 over a quarter turn, and back to 0 at the end."""
    fade = 0.25
    total = cycles + fade

    def ramp(x: Array) -> Array:
        t = np.clip(x / fade, 0.0, 1.0)
        return fade * (2.5 * t**4 - 3 * t**5 + t**6)

    begun = ramp(turns) + np.maximum(turns - fade, 0.0)
    return np.where(turns > total - fade, cycles - ramp(total - turns), begun)


UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "s": 1.0, "ms": 0.001}
_HEADER = re.compile(r"(time|t|x|y)\s*(?:[\[(_/ ]\s*(\w+)\s*[\])]?)?")


def read_csv(path: str | Path) -> tuple[Array | None, Array]:
    """Read a tip path: columns x and y, and time if the path is timed.

    The first line names the columns, with a unit where it is not m or s: ``x [cm]``, ``x_mm``.

    Returns:
        Times (P,) [s], None for a path without; points (P, 2) in `limb_base` [m].

    Raises:
        PlanningError: no such file, no such column or unit, not a number; the message names the
            line and the column.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream, skipinitialspace=True)
            columns = _columns(next(reader, []), path)
            wanted = ["time", "x", "y"] if "time" in columns else ["x", "y"]
            rows = [
                [_number(row, *columns[name], name, path, reader.line_num) for name in wanted]
                for row in reader
                if any(cell.strip() for cell in row)
            ]
    except OSError as error:
        raise PlanningError(f"cannot read tip path {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise PlanningError(f"cannot read tip path {path}: it is not text ({error})") from error
    table = np.array(rows, dtype=float).reshape(-1, len(wanted))
    return (table[:, 0] if len(wanted) == 3 else None), table[:, -2:]


def _columns(header: list[str], path: str | Path) -> dict[str, tuple[int, float]]:
    """Return place and factor to SI of each column that the first line of a file names."""
    found: dict[str, tuple[int, float]] = {}
    for place, text in enumerate(header):
        match = _HEADER.fullmatch(text.strip().lower())
        if match is None:
            continue
        name = "time" if match[1] == "t" else match[1]
        known = ("s", "ms") if name == "time" else ("m", "cm", "mm")
        unit = match[2] or known[0]
        if unit not in known:
            raise PlanningError(
                f"{path}, line 1: column '{text.strip()}' has the unit {unit}: use "
                f"{', '.join(known)}, as in '{name} [{known[-1]}]'"
            )
        found[name] = (place, UNITS[unit])
    missing = [name for name in ("x", "y") if name not in found]
    if missing:
        raise PlanningError(
            f"{path} has no column '{missing[0]}': the first line must name x, y "
            f"and, for a timed path, time, as in 'time [s], x [m], y [m]', with commas between "
            "columns and decimal points; it names "
            f"{[text.strip() for text in header] or 'nothing'}"
        )
    return found


def _number(
    row: list[str], place: int, factor: float, column: str, path: str | Path, line: int
) -> float:
    text = row[place] if place < len(row) else ""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise PlanningError(
            f"{path}, line {line}: column '{column}' is not a number: {text!r}; correct or "
            "remove the line"
        )
    return value * factor
