"""Logs of runs from recorded bags, and from tables of any program through a map of columns."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.files import read_yaml
from der_planner.identification.foreign import (
    LONGEST_SILENCE,
    bends_of,
    is_bag,
    is_ours,
    lines_of,
    read_bag_table,
    read_poses,
)
from der_planner.identification.log import CalibrationLog, LogError, on_grid
from der_planner.model import CONTROL_PERIOD

LEAST_MESSAGES = 10
"""Messages of pressures, and of valid limb states, that a bag must hold."""
UNITS = {
    "time_unit": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "pressure_unit": {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "bar": 1e5, "psi": 6894.757},
    "angle_unit": {"rad": 1.0, "deg": np.pi / 180.0},
    "length_unit": {"m": 1.0, "mm": 1e-3, "cm": 1e-2},
}
"""SI value of each unit that a key of a column map may name."""
REST_SHARE = 0.02
"""Share of a table's largest command below which commands count as rest."""
VENTING_TIME = 5.0
"""Time that chambers need to be at rest after they were filled [s]."""
SEPARATORS = "\t;,"
"""Separators of columns; a table has the first of these that its header holds, or blanks."""


def read_bag(path: str | Path, namespace: str = "") -> CalibrationLog:
    """Read the log of a run. The twin's ground truth is never looked at.

    Args:
        path: bag folder or file.
        namespace: of the limb, e.g. ``/limb``; needed only where a bag holds several.

    Raises:
        LogError: the bag cannot be read, holds several limbs and none is named, or lacks pressures
            or limb states; the message says which.
    """
    from der_planner.bags import reader, record, series  # noqa: PLC0415 - few need bags

    try:
        bag = record.read_record(path)
        measured_limbs = [name for name, limb in bag.limbs.items() if len(limb.measured)]
        chosen = bag.limb_named(namespace, measured_limbs)
    except reader.BagError as error:
        raise LogError(str(error)) from error
    limb, stream = bag.limbs.get(chosen, record.LimbRecord()), series.stream
    if len(limb.measured) < LEAST_MESSAGES:
        raise LogError(
            f"the bag {path} holds no pressures ({record.PRESSURE_TYPE}): was the driver running? "
            "A bag of other programs needs --columns FILE"
        )
    if np.isfinite(limb.tip.values(2)).all(axis=1).sum() < LEAST_MESSAGES:
        raise LogError(
            f"the bag {path} holds no valid limb state ({record.STATE_TYPE}): was the limb seen?"
        )
    count, origin = limb.angles.width, int(limb.measured.stamps().min())
    measured, angles = stream(limb.measured, count, origin), stream(limb.angles, count, origin)
    seen = angles.time[np.isfinite(angles.value).all(axis=1)]
    start, end = max(measured.time[0], seen[0]), min(measured.time[-1], seen[-1])
    if end - start < 1.0:
        raise LogError(f"in {path} pressures and limb states do not overlap: check the clocks")
    grid = np.arange(start, end, CONTROL_PERIOD)
    commanded, tip = stream(limb.commanded, count, origin), stream(limb.tip, 2, origin)
    streams = (commanded, measured, angles, tip)
    tables = [on_grid(one.time, one.value, grid, LONGEST_SILENCE) for one in streams]
    return CalibrationLog(grid - start, tables[0], tables[1], tables[2], tables[3], Path(path).name)


def _names(value: object) -> tuple[str, ...]:
    if not isinstance(value, list):
        raise TypeError
    return tuple(map(str, value))


def _stretches(value: list[Any]) -> tuple[tuple[float, float], ...]:
    return tuple((float(first), float(last)) for first, last in value)


def _rest_until(value: Any) -> float | str:
    return "auto" if value == "auto" else float(value)


_KINDS: dict[Callable[[Any], Any], str] = {
    str: "one word or name",
    float: "a number",
    _names: "a list of columns' names, as [name, name]",
    _stretches: "a list of pairs of times in s, as [[1.5, 3.0]]",
    _rest_until: "a time in s, or auto",
}
"""What reads the value of a key, and what it must be."""


def _key(reading: Callable[[Any], Any], question: str = "", default: Any = MISSING) -> Any:
    """Return the field of a key: what reads its value, and what asks a person for it."""
    return field(default=default, metadata={"reading": reading, "question": question})


@dataclass(frozen=True, kw_only=True)
class ColumnMap:
    """Which column is what, and in which unit; the keys in the order in which they are asked for.

    Attributes:
        time: column of the time.
        time_unit, pressure_unit, angle_unit, length_unit: of `UNITS`.
        commanded: (M,) columns of commanded differential pressures, or (2M,) of commanded chamber
            pressures.
        chambers: (2M,) columns of measured chamber pressures: 0, 1 of segment 0, then of segment 1;
            or (M,) of measured differential pressures.
        poses: table of motion capture in place of the angles; from the folder of the map.
        bodies: body map of the poses; from the folder of the map.
        poses_late: by which the clock of the poses is ahead of the table's [s].
        angles: (M,) columns of the segments' angles; left out where there are poses.
        tip: (2,) columns of x, y in `limb_base`; empty if there are none.
        tags: columns that repeat their last value, all of them, when a tag is lost; empty: never.
        angle_factor: bend angle per listed angle: 2 for chord angles, −1 for the other sign.
        rest_until: rows at rest before this time [s] give the sensors' offsets and are the zero of
            the pressures; a log that does not rest then, and every log with the word ``auto``, has
            its longest rest looked for; 0 keeps the pressures as they are.
        ignore: (first, last) [s] stretches to leave out.
    """

    time: str = _key(str, "column of the time")
    time_unit: str = _key(str, "unit of the time: s, ms or us", "s")
    commanded: tuple[str, ...] = _key(
        _names, "columns of the commands: one a segment, or two, left chamber first"
    )
    chambers: tuple[str, ...] = _key(
        _names, "columns of the measured chamber pressures, left and right of each segment"
    )
    pressure_unit: str = _key(str, "unit of the pressures: Pa, hPa, mbar, kPa, bar or psi", "Pa")
    poses: str = _key(str, "file of motion capture (CSV of Motive, TSV of QTM); empty: none", "")
    bodies: str = _key(str, "body map of it: which body sits where", "")
    poses_late: float = _key(
        float, "what to take off the times of the poses to have those of the table [s]", 0.0
    )
    angles: tuple[str, ...] = _key(_names, "columns of the bend angles, one a segment", ())
    angle_unit: str = _key(str, "unit of the angles: rad or deg", "rad")
    tip: tuple[str, ...] = _key(
        _names, "columns of the tip's x and y in limb_base; empty: none", ()
    )
    length_unit: str = _key(str, "unit of the tip: m, cm or mm", "m")
    tags: tuple[str, ...] = _key(_names, default=())
    angle_factor: float = _key(float, default=1.0)
    rest_until: float | str = _key(_rest_until, default="")
    ignore: tuple[tuple[float, float], ...] = _key(_stretches, default=())

    @classmethod
    def from_yaml(cls, path: str | Path) -> ColumnMap:
        """Read a map.

        Raises:
            LogError: the file cannot be read, or a key is unknown, missing or of another kind.
        """
        content = read_yaml(path, "the column map", LogError)
        if not isinstance(content, Mapping):
            raise LogError(f"the column map {path} must hold keys and values")
        known, given = {item.name: item.metadata["reading"] for item in fields(cls)}, set(content)
        missing = _needed("poses" in given) - given
        wrong = sorted(given - set(known)) + sorted(missing)
        if wrong:
            said = "missing" if wrong[0] in missing else "unknown"
            keys = ", ".join(sorted(known))
            raise LogError(
                f"column map {path}: {wrong[0]} is {said}; the keys are {keys}; commands that were "
                "not logged may be the chambers once more"
            )
        values: dict[str, Any] = {}
        for key, value in content.items():
            try:
                values[key] = known[key](value)
            except (TypeError, ValueError) as error:
                expected = _KINDS[known[key]]
                raise LogError(f"column map {path}: {key} is {value!r}, give {expected}") from error
        for key in ("poses", "bodies"):
            if key in values:
                values[key] = str(Path(path).parent / values[key])
        return cls(**values)

    def factor(self, key: str) -> float:
        """Return the SI value of the unit that a key names.

        Raises:
            LogError: the unit is unknown.
        """
        name = getattr(self, key)
        if name not in UNITS[key]:
            raise LogError(f"{key} is '{name}': choose {', '.join(UNITS[key])}")
        return UNITS[key][name]


def _needed(with_poses: bool) -> set[str]:
    """Return the keys that a map needs, with a table of poses or without."""
    return {"time", "commanded", "chambers", "bodies" if with_poses else "angles"}


_OF_POSES = ("bodies", "poses_late")
_OF_COLUMNS = ("angles", "angle_unit", "tip", "length_unit")


def ask_map(names: Sequence[str], path: Path, ask: Callable[[str], str] = input) -> None:
    """Ask a person what the columns of a log are, and write the answers down.

    Args:
        names: of the columns.
        path: of the map to write.
        ask: shows a question and returns the answer; columns are answered by number or name.

    Raises:
        OSError: the map cannot be written.
    """
    print("\n".join(f"  {k}: {name}" for k, name in enumerate(names)))
    print("answer with numbers or names of columns, with commas between them")
    content: dict[str, Any] = {}
    for item in fields(ColumnMap):
        key, question, with_poses = item.name, item.metadata["question"], "poses" in content
        if not question or key in (_OF_COLUMNS if with_poses else _OF_POSES):
            continue
        words = list[str]()
        while not words:
            words = ask(f"{question}: ").replace(",", " ").split()
            if key not in _needed(with_poses):
                break
        is_list = item.metadata["reading"] is _names
        is_column = is_list or key == "time"
        found = [
            names[int(each)] if is_column and each.isdigit() and int(each) < len(names) else each
            for each in words
        ]
        if found:
            content[key] = found if is_list else found[0]
    path.write_text(yaml.safe_dump(content, sort_keys=False))


def read_csv(path: str | Path, columns: ColumnMap) -> CalibrationLog:
    """Read a log.

    Raises:
        LogError: a column is missing or no number, a unit is unknown, or time falls; the message
            names it.
    """
    pressures, seen = columns.commanded + columns.chambers, columns.angles + columns.tip
    table = read_table(Path(path), {columns.time, *pressures, *seen, *columns.tags})

    def pick(names: tuple[str, ...]) -> Array:
        missing = [name for name in names if name not in table]
        if missing:
            raise LogError(
                f"{path} has no column '{missing[0]}': its columns are {', '.join(table)}"
            )
        return np.stack([table[name] for name in names], axis=1)

    pressure = columns.factor("pressure_unit")
    time = columns.factor("time_unit") * pick((columns.time,))[:, 0]
    tip = np.full((len(time), 2), np.nan)
    if columns.poses:
        poses = read_poses(Path(columns.poses))
        poses = replace(poses, time=poses.time - columns.poses_late)
        angles, tip = bends_of(poses, Path(columns.bodies), time)
    else:
        angles = columns.factor("angle_unit") * columns.angle_factor * pick(columns.angles)
    count, given = angles.shape[1], (len(columns.commanded), len(columns.chambers))
    if not set(given) <= {count, 2 * count}:
        raise LogError(
            f"the log has {count} angles: its column map needs {count} differential pressures or "
            f"{2 * count} chambers as commands and as chambers, got {given[0]} and {given[1]}"
        )
    command, measured = (
        each if each.shape[1] == count else each[:, 0::2] - each[:, 1::2]
        for each in (pressure * pick(columns.commanded), pressure * pick(columns.chambers))
    )
    if columns.tip:
        tip = columns.factor("length_unit") * pick(columns.tip)
    if columns.rest_until != 0:
        rest = _rest(time, command, columns.rest_until)
        if rest.any():
            measured = measured - np.nanmean(measured[rest], axis=0)
        elif columns.rest_until:
            raise LogError(
                f"{path} has no row at rest: its commands never come within "
                f"{100 * REST_SHARE:.0f} % of their largest to zero. Leave rest_until out of the "
                "column map if the chambers' sensors have no offset"
            )
    if columns.tags:
        tags = pick(columns.tags)
        lost = np.all(np.diff(tags, axis=0, prepend=np.nan) == 0, axis=1)
        angles[lost], tip[lost] = np.nan, np.nan
    keep = np.isfinite(time)
    keep[keep] = np.diff(time[keep], prepend=-math.inf) != 0  # of rows at one time the first
    for first, last in columns.ignore:
        keep &= (time < first) | (time > last)
    return CalibrationLog(
        time=time[keep],
        commanded_differential=command[keep],
        measured_differential=measured[keep],
        bend_angles=angles[keep],
        tip=tip[keep],
        source=Path(path).name,
    )


def read_log(path: Path, columns: Path | None, namespace: str = "") -> CalibrationLog:
    """Read a bag of ours, or anybody's bag or table (CSV) by the map of its columns.

    Raises:
        LogError: it cannot be read, or is a table without a map.
    """
    if is_bag(path) and (columns is None or is_ours(path)):
        return read_bag(path, namespace)
    if columns is None:
        raise LogError(f"{path} needs --columns FILE")
    return read_csv(path, ColumnMap.from_yaml(columns))


def _rest(time: Array, command: Array, rest_until: float | str) -> NDArray[np.bool_]:
    """Return which rows are at rest.

    A board's command seldom rests at exactly zero: what counts is its share of the largest one.

    Args:
        time: (K,) [s].
        command: (K, M) in any unit.
        rest_until: [s]; ``auto``, or nothing: the longest rest.
    """
    size = np.abs(command).max(axis=1)
    near: NDArray[np.bool_] = size <= REST_SHARE * np.nanmax(size)
    if not isinstance(rest_until, str) and (near & (time < rest_until)).any():
        return near & (time < rest_until)
    longest = np.zeros(0, dtype=np.int64)
    edges = np.flatnonzero(np.diff(near.astype(int), prepend=0, append=0))
    for first, end in edges.reshape(-1, 2):
        rows = np.arange(first, end)
        if first:  # chambers that were filled before need a while to be at rest
            rows = rows[time[rows] >= time[first] + VENTING_TIME]
        longest = max(longest, rows, key=len)
    rest = np.zeros(len(time), dtype=bool)
    rest[longest] = True
    return rest


def read_table(path: Path, wanted: Collection[str]) -> dict[str, Array]:
    """Return the columns (K,) of a table by the names in its header; missing numbers are NaN.

    A bag has columns as `read_bag_table` says.

    Empty lines are skipped, and a last row that ends early, as that of a program that was killed,
    is left out. Numbers may have a decimal comma where columns are separated by something else, or
    in quotes. Columns that are not wanted may hold anything, and are NaN.

    Raises:
        LogError: the file cannot be read, names a column twice, has fewer than two rows or another
            number of columns in a row, or holds something that is no number; names row and column.
    """
    if is_bag(path):
        return read_bag_table(path)
    header_line, *lines = lines_of(path)
    separator = next((mark for mark in SEPARATORS if mark in header_line), " ")
    if separator == " ":
        header_line, *lines = (" ".join(line.split()) for line in (header_line, *lines))
    header = [name.strip() for name in next(csv.reader([header_line], delimiter=separator))]
    twice = [name for name in header if name and header.count(name) > 1]
    if twice:
        raise LogError(f"the log {path} has two columns '{twice[0]}': name them differently")
    if lines and lines[-1].count(separator) < len(header) - 1:
        lines.pop()
    if len(lines) < 2:
        raise LogError(f"the log {path} has fewer than two rows below its header")
    kinds: dict[int | str, Callable[[str], float]] = {
        k: _number if name in wanted else (lambda _: math.nan) for k, name in enumerate(header)
    }
    try:
        values = np.loadtxt(
            lines, delimiter=separator, converters=kinds, quotechar='"', comments=None, ndmin=2
        )
    except ValueError as error:
        raise LogError(
            f"the log {path}, row 0 being the one below its first line, the header: {error}; a "
            "cell holds a number (a time, too, in s, ms or us), NaN or nothing"
        ) from error
    if values.shape[1] != len(header):
        raise LogError(
            f"the rows of {path} have {values.shape[1]} columns, its header has {len(header)}"
        )
    return dict(zip(header, values.T, strict=True))


def _number(cell: str) -> float:
    value = float(cell.strip().replace(",", ".") or math.nan)
    return value if math.isfinite(value) else math.nan
