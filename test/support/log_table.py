"""A log as a table with its map of columns, as a lab might write it."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import yaml

from der_planner.identification import CalibrationLog


def write_csv(log: CalibrationLog, table: Path, columns: Path) -> None:
    """Write a log as CSV, pressures in hPa and angles in degrees, and the map of its columns."""
    chambers = np.full((len(log.time), 2 * log.segment_count), 1013.0)
    chambers[:, 0::2] += 0.01 * log.measured_differential
    parts = {
        "commanded": 0.01 * log.commanded_differential,
        "chambers": chambers,
        "angles": np.degrees(log.bend_angles),
        "tip": log.tip,
    }
    names = {key: [f"{key}{i}" for i in range(part.shape[1])] for key, part in parts.items()}
    header = ",".join(["t", *itertools.chain(*names.values())])
    values = np.column_stack([log.time, *parts.values()])
    np.savetxt(table, values, delimiter=",", header=header, comments="", fmt="%.8g")
    units = {"pressure_unit": "hPa", "angle_unit": "deg"}
    columns.write_text(yaml.safe_dump({"time": "t", **names, **units}))
