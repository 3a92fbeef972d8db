"""Logs of other programs: tables of motion capture, bags with other messages, and what to ask."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap, BodyMapError
from apriltag_tracker.bodies.tracker import BodyTracker, PoseFrame
from der_planner.arrays import Array
from der_planner.bags.reader import BagError, BagReader
from der_planner.identification.log import LogError, on_grid
from der_planner.model import CONTROL_PERIOD

BAG_SUFFIXES = (".mcap", ".db3")
LONGEST_SILENCE = 0.25
"""Time between two messages or frames that a straight line may bridge [s]."""
_MOTIVE = "Format Version"
_QUALISYS = ("NO_OF_FRAMES", "FILE_VERSION")
_MOTIVE_UNITS = {"Meters": 1.0, "Centimeters": 1e-2, "Millimeters": 1e-3}
_QUALISYS_COLUMNS = 16
"""Of a body: x, y, z, three angles, the residual, nine numbers of the rotation matrix."""


@dataclass(frozen=True)
class PoseLog:
    """Recorded poses of rigid bodies.

    Attributes:
        names: of the n bodies.
        time: (K,) [s].
        positions: (K, n, 3) [m]; NaN where a body was lost.
        quaternions: (K, n, 4) x, y, z, w.
    """

    names: tuple[str, ...]
    time: Array
    positions: Array
    quaternions: Array


def is_bag(path: Path) -> bool:
    """Tell whether a path is that of a bag."""
    return path.is_dir() or path.suffix in BAG_SUFFIXES


def read_poses(path: Path) -> PoseLog:
    """Read rigid bodies from a table of OptiTrack Motive (CSV) or Qualisys QTM (TSV, 6D).

    Raises:
        LogError: it is neither, or holds no rigid bodies with rotations; says how to export them.
    """
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise LogError(f"cannot read the poses {path}: {error.strerror}") from error
    try:
        if text.startswith(_MOTIVE):
            return _motive(path, list(csv.reader(text.splitlines())))
        if text.startswith(_QUALISYS):
            return _qualisys(path, [line.split("\t") for line in text.splitlines()])
    except (ValueError, IndexError) as error:
        raise LogError(f"the table {path} is not as its program writes it: {error}") from error
    raise LogError(
        f"{path} is no table of motion capture that is known: export it from Motive as CSV, or "
        "from QTM as TSV of 6DOF data, each with its header"
    )


def _numbers(rows: Sequence[Sequence[str]], width: int) -> Array:
    """Return rows of numbers (K, width); empty cells and rows that end early are NaN."""
    table = np.full((len(rows), width), np.nan)
    for target, row in zip(table, rows, strict=True):
        cells = [cell.strip() for cell in row[:width]]
        target[: len(cells)] = [float(cell) if cell else np.nan for cell in cells]
    return table


def _motive(path: Path, rows: list[list[str]]) -> PoseLog:
    about = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    unit = _MOTIVE_UNITS.get(about.get("Length Units", "Meters"))
    if unit is None or about.get("Rotation Type", "Quaternion") != "Quaternion":
        raise LogError(
            f"{path}: lengths in {about.get('Length Units')}, rotations as "
            f"{about.get('Rotation Type')}: export meters or millimeters, and quaternions"
        )
    first = next(k for k, row in enumerate(rows) if row and row[0] == "Frame")
    header = {row[1]: row for row in rows[1:first] if len(row) > 1 and row[1]}
    kinds, labels, parts, axes = header["Type"], header["Name"], rows[first - 1], rows[first]
    columns: dict[str, dict[tuple[str, str], int]] = {}
    for k in range(2, len(axes)):
        if kinds[k] == "Rigid Body":
            columns.setdefault(labels[k], {})[parts[k], axes[k]] = k
    table = _numbers([row for row in rows[first + 1 :] if row], len(axes))
    names = tuple(name for name, found in columns.items() if ("Rotation", "W") in found)
    if not names:
        raise LogError(f"{path} holds no rigid bodies: export them from Motive, not markers alone")
    positions = [[columns[name]["Position", axis] for axis in "XYZ"] for name in names]
    turns = [[columns[name]["Rotation", axis] for axis in "XYZW"] for name in names]
    return PoseLog(names, table[:, 1], unit * table[:, positions], table[:, turns])


def _qualisys(path: Path, rows: list[list[str]]) -> PoseLog:
    about = {row[0]: row[1:] for row in rows if row and row[0].isupper()}
    names = tuple(name for name in about.get("BODY_NAMES", []) if name)
    if not names:
        raise LogError(f"{path} holds no rigid bodies: export 6DOF data from QTM, with its header")
    data = [row for row in rows if row and _is_number(row[0])]
    width = max(len(row) for row in data)
    lead = width - _QUALISYS_COLUMNS * len(names)
    # A last tab makes a column that holds nothing.
    lead -= all(len(row) < width or not row[-1].strip() for row in data)
    if lead not in (0, 1, 2):
        raise LogError(
            f"{path} has {width} columns for {len(names)} bodies: {_QUALISYS_COLUMNS} a body are "
            "expected, after frame and time"
        )
    table = _numbers(data, lead + _QUALISYS_COLUMNS * len(names))
    time = table[:, 1] if lead == 2 else np.arange(len(table)) / float(about["FREQUENCY"][0])
    bodies = table[:, lead:].reshape(len(table), len(names), _QUALISYS_COLUMNS)
    # The nine numbers go down the columns of the matrix; a body that is lost is all zeros.
    matrices = bodies[..., 7:].reshape(*bodies.shape[:2], 3, 3).swapaxes(-1, -2)
    lost = ~np.isfinite(bodies).all(axis=2) | (np.abs(matrices).sum(axis=(-1, -2)) < 0.5)
    matrices = np.where(lost[..., None, None], np.eye(3), matrices)
    quaternions = Rotation.from_matrix(matrices.reshape(-1, 3, 3)).as_quat()
    positions = np.where(lost[..., None], np.nan, 1e-3 * bodies[..., :3])
    return PoseLog(names, time, positions, quaternions.reshape(*lost.shape, 4))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def bends_of(log: PoseLog, body_map: Path) -> tuple[Array, Array]:
    """Return bend angles (K, M) [rad] and tips (K, 2) [m] of recorded poses; NaN where not told.

    Raises:
        LogError: the map cannot be read, names a body that the log has not, or the limb was never
            seen; says why.
    """
    try:
        bodies = BodyMap.from_yaml(body_map)
    except BodyMapError as error:
        raise LogError(str(error)) from error
    missing = [name for name in bodies.names if name not in log.names]
    if missing:
        raise LogError(f"the poses have no body '{missing[0]}': theirs are {', '.join(log.names)}")
    order = [log.names.index(name) for name in bodies.names]
    tracker = BodyTracker(bodies)
    angles = np.full((len(log.time), len(bodies.segment_lengths)), np.nan)
    tips = np.full((len(log.time), 2), np.nan)
    reason = "the log is empty"
    for k, instant in enumerate(log.time):
        positions = log.positions[k, order] / bodies.unit
        frame = PoseFrame(round(1e9 * instant), positions, log.quaternions[k, order])
        followed = tracker.observe(frame).followed
        if followed.estimate is None:
            reason = followed.reason
        elif not followed.bridged:
            angles[k], tips[k] = followed.estimate.bend_angle, followed.estimate.tip
    if np.isnan(tips).all():
        raise LogError(f"no frame of the poses shows the limb: {reason}")
    return angles, tips


def read_bag_table(path: Path) -> dict[str, Array]:
    """Return what a bag of anybody's says in numbers, by name, on one grid of 50 ms under ``time``.

    A `sensor_msgs/JointState` gives ``TOPIC.JOINT.position`` and so on, an array ``TOPIC[0]``, a
    `sensor_msgs/FluidPressure` ``TOPIC``.

    Raises:
        LogError: the bag cannot be read, or holds none of these.
    """
    found: dict[str, tuple[list[float], list[float]]] = {}
    try:
        with BagReader(path) as bag:
            for topic, logged, message in bag.messages(list(bag.topics)):
                header = getattr(message, "header", None)
                stamp = logged * 1e-9
                if header is not None and header.stamp.sec:
                    stamp = header.stamp.sec + header.stamp.nanosec * 1e-9
                for name, value in _values(topic, message).items():
                    times, values = found.setdefault(name, ([], []))
                    times.append(stamp)
                    values.append(value)
    except BagError as error:
        raise LogError(str(error)) from error
    found = {name: kept for name, kept in found.items() if len(kept[0]) > 1}
    if not found:
        raise LogError(f"the bag {path} holds no joint states, arrays or fluid pressures")
    start = max(min(times) for times, _ in found.values())
    end = min(max(times) for times, _ in found.values())
    if end - start < 1.0:
        raise LogError(f"the topics of {path} do not overlap: do their clocks agree?")
    grid = np.arange(start, end, CONTROL_PERIOD)
    table = {"time": grid - start}
    for name, (times, values) in found.items():
        instants, rows = np.unique(np.array(times), return_index=True)
        column = np.array(values)[rows][:, None]
        table[name] = on_grid(instants, column, grid, LONGEST_SILENCE)[:, 0]
    return table


def _values(topic: str, message: Any) -> dict[str, float]:
    """Return the numbers of one message by name."""
    if hasattr(message, "effort"):
        return {
            f"{topic}.{name}.{kind}": float(value)
            for kind in ("position", "velocity", "effort")
            for name, value in zip(message.name, getattr(message, kind), strict=False)
        }
    if hasattr(message, "fluid_pressure"):
        return {topic: float(message.fluid_pressure)}
    data = getattr(message, "data", None)
    if isinstance(data, np.ndarray) and data.dtype.kind in "fi" and data.size <= 64:
        return {f"{topic}[{k}]": float(value) for k, value in enumerate(data)}
    return {}


# What to ask --------------------------------------------------------------------------------------

QUESTIONS = (
    ("time", "column of the time", False),
    ("time_unit", "unit of the time: s, ms or us", False),
    ("commanded", "columns of the commands: one a segment, or two, left chamber first", True),
    ("chambers", "columns of the measured chamber pressures, left and right of each segment", True),
    ("pressure_unit", "unit of the pressures: Pa, hPa, mbar, kPa, bar or psi", False),
    ("poses", "file of motion capture (CSV of Motive, TSV of QTM); empty: none", False),
    ("bodies", "body map of it: which body sits where", False),
    ("poses_late", "what to take off the times of the poses to have those of the table [s]", False),
    ("angles", "columns of the bend angles, one a segment", True),
    ("angle_unit", "unit of the angles: rad or deg", False),
    ("tip", "columns of the tip's x and y in limb_base; empty: none", True),
    ("length_unit", "unit of the tip: m, cm or mm", False),
)
"""Keys of a map of columns, what to ask for each, and whether the answer is a list."""
_WITH_POSES = ("bodies", "poses_late")
_WITHOUT_POSES = ("angles", "angle_unit", "tip", "length_unit")


def ask_map(names: Sequence[str], path: Path, ask: Callable[[str], str] = input) -> dict[str, Any]:
    """Ask a person what the columns of a log are, and write the answers down for ever.

    Args:
        names: of the columns.
        path: of the map to write.
        ask: shows a question and returns the answer; columns are answered by number or name.

    Raises:
        LogError: the map cannot be written.
    """
    listed = "\n".join(f"  {k}: {name}" for k, name in enumerate(names))
    shown = f"The log has these columns:\n{listed}\n"
    content: dict[str, Any] = {}
    for key, question, is_list in QUESTIONS:
        if key in (_WITHOUT_POSES if content.get("poses") else _WITH_POSES):
            continue
        answer = ask(f"{shown}{question}: ").strip()
        shown = ""
        if not answer:
            continue
        words = answer.replace(",", " ").split()
        picked = [
            names[int(word)] if word.isdigit() and int(word) < len(names) else word
            for word in words
        ]
        if is_list:
            content[key] = picked
        elif key == "poses_late":
            content[key] = float(answer)
        else:
            content[key] = picked[0] if key == "time" else answer
    try:
        path.write_text(yaml.safe_dump(content, sort_keys=False))
    except OSError as error:
        raise LogError(f"cannot write the map of columns {path}: {error.strerror}") from error
    return content


def joined(log: PoseLog, found: tuple[Array, Array], time: Array) -> tuple[Array, Array]:
    """Return bend angles and tips of poses at the times (K,) of a table [s]; NaN in gaps."""
    angles, tips = found
    instants, rows = np.unique(log.time, return_index=True)
    grid: NDArray[np.float64] = np.asarray(time, dtype=np.float64)
    return (
        on_grid(instants, angles[rows], grid, LONGEST_SILENCE),
        on_grid(instants, tips[rows], grid, LONGEST_SILENCE),
    )
