"""Logs as CSV tables of any lab, read through a map of columns."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from der_planner.identification.logs.log import CalibrationLog, LogError

Array = NDArray[np.float64]

PRESSURE_UNITS = {"Pa": 1.0, "hPa": 100.0, "kPa": 1000.0, "psi": 6894.757}
ANGLE_UNITS = {"rad": 1.0, "deg": np.pi / 180.0}
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}
REST_SHARE = 0.02
"""Commands below this share of the log's largest one count as rest."""
VENTING_TIME = 5.0
"""Time [s] that chambers need to be at rest after they were filled."""


@dataclass(frozen=True)
class ColumnMap:
    """Which column is what, and in which unit.

    Attributes:
        time: column of the time [s].
        commanded: (M,) columns of commanded differential pressures.
        chambers: (2M,) columns of measured chamber pressures: 0, 1 of segment 0, then of segment 1.
        angles: (M,) columns of the segments' angles.
        tip: (2,) columns of x, y in `limb_base`; empty if there are none.
        tags: columns that repeat their last value, all of them, when a tag is lost; empty: never.
        pressure_unit, angle_unit, length_unit: see `PRESSURE_UNITS`, `ANGLE_UNITS`, `LENGTH_UNITS`.
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
            LogError: the file cannot be read, or a key is unknown or missing.
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
        values: dict[str, Any] = {
            key: tuple(tuple(v) if isinstance(v, list) else v for v in value)
            if isinstance(value, list)
            else value
            for key, value in content.items()
        }
        return cls(**values)


def read_csv(path: str | Path, columns: ColumnMap) -> CalibrationLog:
    """Read a log.

    Raises:
        LogError: a column is missing or no number, or a unit is unknown; the message names it.
    """
    table = _table(Path(path))
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

    time = pick((columns.time,))[:, 0]
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
    keep = np.ones(len(time), dtype=bool)
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


def _table(path: Path) -> dict[str, Array]:
    try:
        with path.open(newline="") as stream:
            rows = list(csv.reader(stream))
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from error
    if len(rows) < 3:
        raise LogError(f"the log {path} has fewer than two rows below its header")
    header = [name.strip() for name in rows[0]]
    try:
        values = np.array([[float(v) if v.strip() else np.nan for v in row] for row in rows[1:]])
    except ValueError as error:
        raise LogError(f"the log {path} holds something that is no number: {error}") from error
    if values.ndim != 2 or values.shape[1] != len(header):
        raise LogError(f"the rows of {path} do not have {len(header)} columns each")
    return {name: values[:, index] for index, name in enumerate(header)}
