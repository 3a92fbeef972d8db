"""Logs of other programs: tables of motion capture, and bags with other messages."""

from __future__ import annotations

import codecs
import csv
import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import dropwhile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from der_planner.arrays import Array
from der_planner.identification.log import LogError, on_grid
from der_planner.model import CONTROL_PERIOD

LONGEST_SILENCE = 0.25
"""Time between two messages or frames that a straight line may bridge [s]."""
_MOTIVE, _QUALISYS = "Format Version", ("NO_OF_FRAMES", "FILE_VERSION")
"""First words of the tables."""
_MOTIVE_UNITS = {"Meters": 1.0, "Centimeters": 1e-2, "Millimeters": 1e-3}
_LARGEST_ARRAY = 64
"""Longer arrays in bags are pictures and the like."""


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
    """Tell whether a path is that of a bag; one of nothing is, if it has no ending."""
    nothing = not (path.suffix or path.exists())
    return nothing or path.is_dir() or path.suffix in (".mcap", ".db3")


def is_ours(path: Path) -> bool:
    """Tell whether a bag is of our driver; one that cannot be read says why when it is read."""
    from der_planner.bags import reader, record  # noqa: PLC0415

    try:
        with reader.BagReader(path) as bag:
            return any(topic.type_name == record.PRESSURE_TYPE for topic in bag.topics.values())
    except reader.BagError:
        return True


def read_poses(path: Path) -> PoseLog:
    """Read rigid bodies from a table of OptiTrack Motive (CSV) or Qualisys QTM (TSV, 6D).

    Raises:
        LogError: it is neither, or holds no rigid bodies with rotations; says how to export them.
    """
    lines = lines_of(path)
    start = lines[0]
    try:
        if start.startswith(_MOTIVE):
            return _motive(path, lines)
        if start.startswith(_QUALISYS):
            return _qualisys(path, lines)
    except (ValueError, IndexError, KeyError, StopIteration) as error:
        raise LogError(f"the table {path} is not as its program writes it: {error}") from error
    raise LogError(f"{path}: export it from Motive as CSV, or from QTM as TSV of 6DOF, with header")


def lines_of(path: Path) -> list[str]:
    """Return the lines that hold something, the header first: of `numpy.savetxt` a comment."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise LogError(f"cannot read the log {path}: {error.strerror}") from error
    wide = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if b"\0" in content and not wide:
        raise LogError(f"the log {path} is no text: write it as CSV")
    try:
        text = content.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        # Names of columns may hold a degree sign of an older program.
        text = content.decode("cp1252", errors="replace")
    written = [line for line in text.splitlines() if line.strip()]
    lines = list(dropwhile(lambda line: line.lstrip().startswith("#"), written))
    if not lines:
        raise LogError(f"the log {path} is empty")
    if len(lines) < len(written) and re.match(r'[\s"]*[-+.\d]', lines[0]):
        lines.insert(0, written[-len(lines) - 1].lstrip("# "))
    return lines


def _motive(path: Path, lines: Sequence[str]) -> PoseLog:
    first = next(k for k, line in enumerate(lines) if line.startswith("Frame,"))
    rows = list(csv.reader(lines[: first + 1]))
    about = dict(zip(rows[0][::2], rows[0][1::2], strict=False))
    unit = _MOTIVE_UNITS.get(about.get("Length Units", "Meters"))
    if unit is None or about.get("Rotation Type", "Quaternion") != "Quaternion":
        told = f"lengths in {about.get('Length Units')}, rotations as {about.get('Rotation Type')}"
        raise LogError(f"{path}: {told}: export meters or millimeters, and quaternions")
    header = {row[1]: row for row in rows[1:] if len(row) > 1}
    heads = zip(header["Type"], header["Name"], *rows[-2:], strict=False)
    columns = {head: k for k, head in enumerate(heads)}
    names = tuple(name for kind, name, part, axis in columns if (kind, part, axis) == _BODY)
    if not names:
        raise LogError(f"{path} holds no rigid bodies: export them from Motive, not markers alone")
    table = np.genfromtxt(lines[first + 1 :], delimiter=",")
    places, turns = (
        [[columns["Rigid Body", name, part, axis] for axis in axes] for name in names]
        for part, axes in (("Position", "XYZ"), ("Rotation", "XYZW"))
    )
    return PoseLog(names, table[:, 1], unit * table[:, places], table[:, turns])


_BODY = ("Rigid Body", "Rotation", "W")
"""Each rigid body of Motive has one such column."""


def _qualisys(path: Path, lines: Sequence[str]) -> PoseLog:
    first = next(k for k, line in enumerate(lines) if "Rot[0]" in line or k == len(lines) - 1)
    about = {word: rest for word, *rest in (line.split("\t") for line in lines[:first])}
    names = tuple(name for name in about.get("BODY_NAMES", []) if name)
    heads = lines[first].split("\t")
    # x, y, z [mm], three angles and the residual stand before the matrix.
    starts = np.array([k - 7 for k, head in enumerate(heads) if head == "Rot[0]"], dtype=np.int64)
    if not names or len(starts) != len(names):
        raise LogError(f"{path} holds no rigid bodies: export 6DOF data from QTM, with its header")
    table = np.genfromtxt(lines[first + 1 :], delimiter="\t")
    time = np.arange(len(table)) / float(about["FREQUENCY"][0])
    if "Time" in heads:
        time = table[:, heads.index("Time")]
    positions = 1e-3 * table[:, starts[:, None] + np.arange(3)]
    # The nine numbers go down the columns of the matrix; a body that is lost is all zeros.
    matrices = table[:, starts[:, None] + np.arange(7, 16)].reshape(*positions.shape, 3)
    lost = ~(np.abs(np.linalg.det(matrices) - 1.0) < 0.1)
    matrices[lost], positions[lost] = np.eye(3), np.nan
    quaternions = Rotation.from_matrix(matrices.swapaxes(-1, -2).reshape(-1, 3, 3)).as_quat()
    return PoseLog(names, time, positions, quaternions.reshape(*lost.shape, 4))


def bends_of(log: PoseLog, body_map: Path, time: Array) -> tuple[Array, Array]:
    """Return bend angles (L, M) [rad] and tips (L, 2) [m] at times (L,) [s]; NaN where not told.

    Raises:
        LogError: the map cannot be read, names a body that the log has not, or the limb was never
            seen; says why.
    """
    # Only who reads motion capture needs the tracker.
    from apriltag_tracker.bodies.body_map import BodyMap  # noqa: PLC0415
    from apriltag_tracker.bodies.tracker import BodyTracker, PoseFrame  # noqa: PLC0415
    from apriltag_tracker.tag_map import MapError  # noqa: PLC0415

    try:
        bodies = BodyMap.from_yaml(body_map)
    except MapError as error:
        raise LogError(str(error)) from error
    missing = [name for name in bodies.names if name not in log.names]
    if missing:
        raise LogError(f"the poses have no body '{missing[0]}': theirs are {', '.join(log.names)}")
    order = [log.names.index(name) for name in bodies.names]
    tracker, reason = BodyTracker(bodies), "the log is empty"
    angles = np.full((len(log.time), len(bodies.segment_lengths)), np.nan)
    tips = np.full((len(log.time), 2), np.nan)
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
    angles, tips = (on_grid(log.time, each, time, LONGEST_SILENCE) for each in (angles, tips))
    return angles, tips


def read_bag_table(path: Path) -> dict[str, Array]:
    """Return what a bag of anybody's says in numbers, by name, on one grid of 50 ms under ``time``.

    A `sensor_msgs/JointState` gives ``TOPIC.JOINT.position`` and so on, an array ``TOPIC[0]``, a
    `sensor_msgs/FluidPressure` ``TOPIC``.

    Raises:
        LogError: the bag cannot be read, or holds none of these.
    """
    from der_planner.bags import reader, record, series  # noqa: PLC0415 - few need bags

    found: defaultdict[str, record.Columns] = defaultdict(record.Columns)
    try:
        with reader.BagReader(path) as bag:
            for topic, logged, message in bag.messages(list(bag.topics)):
                stamp = record.header_stamp(message) if hasattr(message, "header") else 0
                for name, value in _values(topic, message).items():
                    found[name].append(stamp or logged, (value,))
    except reader.BagError as error:
        raise LogError(str(error)) from error
    known = {name: rows for name, rows in found.items() if len(rows) > 1}
    if not known:
        raise LogError(f"the bag {path} holds no joint states, arrays or fluid pressures")
    origin = max(int(rows.stamps().min()) for rows in known.values())
    streams = {name: series.stream(rows, 1, origin) for name, rows in known.items()}
    end = min(each.time[-1] for each in streams.values())
    if end < 1.0:
        raise LogError(f"the topics of {path} do not overlap: do their clocks agree?")
    grid = np.arange(0.0, end, CONTROL_PERIOD)
    return {"time": grid} | {
        name: on_grid(each.time, each.value, grid, LONGEST_SILENCE)[:, 0]
        for name, each in streams.items()
    }


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
    if isinstance(data, np.ndarray) and data.dtype.kind in "fi" and data.size <= _LARGEST_ARRAY:
        return {f"{topic}[{k}]": float(value) for k, value in enumerate(data)}
    return {}
