"""Logs of runs from recorded bags, and from tables of any program through a map of columns."""

from __future__ import annotations

import codecs
import csv
import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.bags.reader import BagError
from der_planner.bags.record import PRESSURE_TYPE, STATE_TYPE, BagRecord, LimbRecord, read_record
from der_planner.bags.run import Stream
from der_planner.bags.series import stream
from der_planner.identification.log import CalibrationLog, LogError, on_grid
from der_planner.model import CONTROL_PERIOD

LONGEST_GAP = 0.25
"""Time between two messages of a bag that a straight line may bridge [s]."""
LEAST_MESSAGES = 10
"""Messages of pressures, and of valid limb states, that a bag must hold."""
TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
PRESSURE_UNITS = {
    "Pa": 1.0,
    "hPa": 100.0,
    "mbar": 100.0,
    "kPa": 1000.0,
    "bar": 1e5,
    "psi": 6894.757,
}
ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
REST_SHARE = 0.02
"""Share of a table's largest command below which commands count as rest."""
VENTING_TIME = 5.0
"""Time that chambers need to be at rest after they were filled [s]."""
SEPARATORS = "\t;,"
"""Separators of columns; a table has the first of these that its header holds."""


def read_bag(path: str | Path, namespace: str = "") -> CalibrationLog:
    """Read the log of a run. The twin's ground truth is never looked at.

    Args:
        path: bag folder or file.
        namespace: of the limb, e.g. ``/limb``; needed only where a bag holds several.

    Raises:
        LogError: the bag cannot be read, holds several limbs and none is named, or lacks pressures
            or limb states; the message says which.
    """
    try:
        record = read_record(path)
    except BagError as error:
        raise LogError(str(error)) from error
    limb = _choose_limb(record, namespace)
    if len(limb.measured) < LEAST_MESSAGES:
        raise LogError(
            f"the bag {path} holds no pressures ({PRESSURE_TYPE}): was the driver running?"
        )
    if np.isfinite(limb.tip.values(2)).all(axis=1).sum() < LEAST_MESSAGES:
        raise LogError(
            f"the bag {path} holds no valid limb state ({STATE_TYPE}): was the limb seen?"
        )
    count, origin = limb.angles.width, int(limb.measured.stamps().min())
    measured, angles = stream(limb.measured, count, origin), stream(limb.angles, count, origin)
    seen = angles.time[np.isfinite(angles.value).all(axis=1)]
    start, end = max(measured.time[0], seen[0]), min(measured.time[-1], seen[-1])
    if end - start < 1.0:
        raise LogError(f"in {path} pressures and limb states do not overlap: check the clocks")
    grid = np.arange(start, end, CONTROL_PERIOD)
    commanded, tip = stream(limb.commanded, count, origin), stream(limb.tip, 2, origin)

    def table(one: Stream) -> Array:
        columns = [on_grid(one.time, column, grid, LONGEST_GAP) for column in one.value.T]
        return np.stack(columns, axis=1)

    return CalibrationLog(
        grid - start,
        table(commanded),
        table(measured),
        table(angles),
        table(tip),
        Path(path).name,
    )


def _choose_limb(record: BagRecord, namespace: str) -> LimbRecord:
    if namespace:
        if namespace not in record.limbs:
            known = ", ".join(sorted(record.limbs)) or "none"
            raise LogError(f"the bag {record.path} has no limb {namespace}, only {known}")
        return record.limbs[namespace]
    driven = [name for name, limb in record.limbs.items() if len(limb.measured)]
    if len(driven) > 1:
        raise LogError(
            f"the bag {record.path} holds several limbs, {', '.join(sorted(driven))}: name one "
            "with --namespace"
        )
    return record.limbs[driven[0]] if driven else LimbRecord()


@dataclass(frozen=True)
class ColumnMap:
    """Which column is what, and in which unit.

    Attributes:
        time: column of the time.
        commanded: (M,) columns of commanded differential pressures.
        chambers: (2M,) columns of measured chamber pressures: 0, 1 of segment 0, then of segment 1.
        angles: (M,) columns of the segments' angles.
        tip: (2,) columns of x, y in `limb_base`; empty if there are none.
        tags: columns that repeat their last value, all of them, when a tag is lost; empty: never.
        time_unit, pressure_unit, angle_unit, length_unit: see `TIME_UNITS`, `PRESSURE_UNITS`,
            `ANGLE_UNITS`, `LENGTH_UNITS`.
        angle_factor: bend angle per listed angle: 2 for chord angles, −1 for the other sign.
        rest_until: rows at rest before this time [s] give the sensors' offsets and are the zero of
            the pressures; a log that does not rest then, and every log with the word ``auto``, has
            its longest rest looked for; 0 keeps the pressures as they are.
        ignore: (first, last) [s] stretches to leave out.
    """

    time: str
    commanded: tuple[str, ...]
    chambers: tuple[str, ...]
    angles: tuple[str, ...]
    tip: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()
    time_unit: str = "s"
    pressure_unit: str = "Pa"
    angle_unit: str = "rad"
    length_unit: str = "m"
    angle_factor: float = 1.0
    rest_until: float | str = 0.0
    ignore: tuple[tuple[float, float], ...] = ()

    @classmethod
    def from_yaml(cls, path: str | Path) -> ColumnMap:
        """Read a map.

        Raises:
            LogError: the file cannot be read, or a key is unknown, missing or of another kind.
        """
        try:
            content = yaml.safe_load(Path(path).read_text())
        except (OSError, yaml.YAMLError) as error:
            raise LogError(f"cannot read the column map {path}: {error}") from error
        if not isinstance(content, Mapping):
            raise LogError(f"the column map {path} must hold keys and values")
        known = {item.name for item in fields(cls)}
        unknown = sorted(set(content) - known)
        missing = sorted({"time", "commanded", "chambers", "angles"} - set(content))
        if unknown or missing:
            raise LogError(
                f"column map {path}: "
                + (f"unknown key {unknown[0]}; " if unknown else "")
                + (f"{missing[0]} is missing; " if missing else "")
                + f"the keys are {', '.join(sorted(known))}"
            )
        values: dict[str, Any] = {}
        for key, value in content.items():
            fits, expected = _KINDS.get(key, _TEXT)
            if not fits(value):
                raise LogError(f"column map {path}: {key} is {value!r}, give {expected}")
            values[key] = value
            if isinstance(value, list):
                values[key] = tuple(tuple(v) if isinstance(v, list) else v for v in value)
        return cls(**values)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_names(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


def _is_stretches(value: object) -> bool:
    return isinstance(value, list) and all(
        isinstance(pair, list) and len(pair) == 2 and all(map(_is_number, pair)) for pair in value
    )


_NAMES = (_is_names, "a list of columns' names, as [name, name]")
_TEXT = (lambda value: isinstance(value, str), "one word or name")
_KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    **dict.fromkeys(("commanded", "chambers", "angles", "tags"), _NAMES),
    "tip": (
        lambda value: _is_names(value) and len(value) in (0, 2),
        "the two columns of x and y, as [name, name]",
    ),
    "angle_factor": (lambda value: _is_number(value) and value != 0, "a number, not 0"),
    "rest_until": (lambda value: value == "auto" or _is_number(value), "a time in s, or auto"),
    "ignore": (_is_stretches, "a list of pairs of times in s, as [[1.5, 3.0]]"),
}
"""What the value of a key must be, and how that is said; a key that is not here is `_TEXT`."""


def read_csv(path: str | Path, columns: ColumnMap) -> CalibrationLog:
    """Read a log.

    Raises:
        LogError: a column is missing or no number, a unit is unknown, or time falls; the message
            names it.
    """
    table = read_table(Path(path))
    pressure = _unit(columns.pressure_unit, PRESSURE_UNITS, "pressure_unit")
    angle = _unit(columns.angle_unit, ANGLE_UNITS, "angle_unit") * columns.angle_factor
    length = _unit(columns.length_unit, LENGTH_UNITS, "length_unit")
    count = len(columns.angles)
    if len(columns.commanded) != count or len(columns.chambers) != 2 * count:
        raise LogError(
            f"the column map names {count} angles: it needs {count} commands and {2 * count} "
            f"chambers, "
            f"got {len(columns.commanded)} and {len(columns.chambers)}"
        )

    def pick(names: tuple[str, ...]) -> Array:
        missing = [name for name in names if name not in table]
        if missing:
            raise LogError(
                f"{path} has no column '{missing[0]}': its columns are {', '.join(table)}"
            )
        return np.stack([table[name] for name in names], axis=1)

    seconds = _unit(columns.time_unit, TIME_UNITS, "time_unit")
    time = seconds * pick((columns.time,))[:, 0]
    command, chambers = pick(columns.commanded), pick(columns.chambers)
    angles = pick(columns.angles)
    tip = pick(columns.tip) if columns.tip else np.full((len(time), 2), np.nan)
    measured = chambers[:, 0::2] - chambers[:, 1::2]
    if columns.rest_until != 0:
        rest = _rest(time, command, columns.rest_until)
        if not rest.any():
            raise LogError(
                f"{path} has no row at rest: its commands never come within "
                f"{100 * REST_SHARE:.0f} % of their largest to zero. Leave rest_until out of the "
                "column map if the chambers' sensors have no offset"
            )
        measured = measured - np.nanmean(measured[rest], axis=0)
    if columns.tags:
        tags = pick(columns.tags)
        lost = np.all(np.diff(tags, axis=0, prepend=np.nan) == 0, axis=1)
        angles[lost], tip[lost] = np.nan, np.nan
    keep = _timed(time, path)
    for first, last in columns.ignore:
        keep &= (time < first) | (time > last)
    return CalibrationLog(
        time=time[keep],
        commanded_differential=pressure * command[keep],
        measured_differential=pressure * measured[keep],
        bend_angles=angle * angles[keep],
        tip=length * tip[keep],
        source=Path(path).name,
    )


def _timed(time: Array, path: str | Path) -> NDArray[np.bool_]:
    """Return which rows have a time of their own (K,); of rows at one time the first.

    Raises:
        LogError: the time falls from one row to the next.
    """
    known = np.flatnonzero(np.isfinite(time))
    step = np.diff(time[known])
    if (step < 0).any():
        row = int(np.argmax(step < 0))
        raise LogError(
            f"the time of {path} falls from {time[known[row]]:.6g} s to "
            f"{time[known[row + 1]]:.6g} s: is it more than one run, or has a clock been set? Keep "
            "one run a table"
        )
    keep = np.zeros(len(time), dtype=bool)
    keep[known[np.append(True, step > 0)[: len(known)]]] = True
    return keep


def _rest(time: Array, command: Array, rest_until: float | str) -> NDArray[np.bool_]:
    """Return which rows are at rest.

    A board's command seldom rests at exactly zero: what counts is its share of the largest one.

    Args:
        time: (K,) [s].
        command: (K, M) in any unit.
        rest_until: [s], or ``auto``.

    Raises:
        LogError: it is neither.
    """
    if isinstance(rest_until, str) and rest_until != "auto":
        raise LogError(f"rest_until is '{rest_until}': give a time in s, or auto")
    size = np.abs(command).max(axis=1)
    near: NDArray[np.bool_] = size <= REST_SHARE * np.nanmax(size)
    if not isinstance(rest_until, str):
        early: NDArray[np.bool_] = near & (time < rest_until)
        if early.any():
            return early
    edges = np.flatnonzero(np.diff(near.astype(int), prepend=0, append=0))
    rest = np.zeros(len(time), dtype=bool)
    stretches = [
        # Chambers that were filled before need a while to be at rest.
        np.flatnonzero(time[first:end] >= (time[first] + VENTING_TIME if first else -np.inf))
        + first
        for first, end in edges.reshape(-1, 2)
    ]
    if stretches:
        rest[max(stretches, key=lambda rows: float(np.ptp(time[rows])) if len(rows) else -1.0)] = (
            True
        )
    return rest


def _unit(name: str, known: Mapping[str, float], key: str) -> float:
    if name not in known:
        raise LogError(f"{key} is '{name}': choose {', '.join(known)}")
    return known[name]


def read_table(path: Path) -> dict[str, Array]:
    """Return the columns (K,) of a table by the names in its header; missing numbers are NaN.

    Lines before the header that begin with ``#`` and empty lines are skipped, and a last row that
    ends early, as that of a program that was killed, is left out. Numbers may have a decimal comma
    where columns are separated by something else, or in quotes.

    Raises:
        LogError: the file cannot be read, names a column twice, has fewer than two rows or another
            number of columns in a row, or holds something that is no number; names line and column.
    """
    lines = _lines(path)
    if not lines:
        raise LogError(f"the log {path} is empty")
    separator = next((mark for mark in SEPARATORS if mark in lines[0][1]), ",")
    rows = list(csv.reader((text for _, text in lines), delimiter=separator))
    header = [name.strip() for name in rows[0]]
    twice = [name for name, count in Counter(header).items() if name and count > 1]
    if twice:
        raise LogError(f"the log {path} has two columns '{twice[0]}': name them differently")
    if len(rows) > 1 and len(rows[-1]) < len(header):
        rows.pop()
    if len(rows) < 3:
        raise LogError(f"the log {path} has fewer than two rows below its header")
    values = np.empty((len(rows) - 1, len(header)))
    for index, row in enumerate(rows[1:]):
        number = lines[index + 1][0]
        if len(row) != len(header):
            raise LogError(
                f"line {number} of {path} has {len(row)} columns, its header has {len(header)}"
            )
        for place, cell in enumerate(row):
            values[index, place] = _number(
                cell, f"line {number}, column '{header[place]}' of {path}"
            )
    return {name: values[:, index] for index, name in enumerate(header)}


def read_log(path: Path, columns: Path | None, namespace: str = "") -> CalibrationLog:
    """Read a bag, or a table (CSV) by the map of its columns.

    Raises:
        LogError: it cannot be read, or is a table without a map.
    """
    if path.suffix != ".csv":
        return read_bag(path, namespace)
    if columns is None:
        raise LogError(f"{path} needs --columns FILE")
    return read_csv(path, ColumnMap.from_yaml(columns))


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines that hold something, with their numbers from 1; the first is the header."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from error
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        text = content.decode("utf-16", errors="replace")
    else:
        try:
            text = content.decode("utf-8-sig")
        except UnicodeDecodeError:
            # Names of columns may hold a degree sign of an older program.
            text = content.decode("cp1252", errors="replace")
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    while lines and lines[0][1].lstrip().startswith("#"):
        lines.pop(0)
    return lines


def _number(cell: str, where: str) -> float:
    text = cell.strip()
    if not text:
        return math.nan
    try:
        value = float(text if "," not in text else text.replace(",", "."))
    except ValueError as error:
        raise LogError(
            f"{where} is '{text}', which is no number: leave cells without a value empty, or write "
            "NaN"
        ) from error
    return value if math.isfinite(value) else math.nan
