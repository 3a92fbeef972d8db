"""A log as a table with its map of columns, as a lab might write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from der_planner.identification import CalibrationLog


def write_csv(log: CalibrationLog, table: Path, columns: Path) -> None:
    """Write a log as CSV, pressures in hPa and angles in degrees, and the map of its columns."""
    chambers = np.zeros((len(log.time), 2 * log.segment_count))
    chambers[:, 0::2] = 1013.0 + 0.01 * log.measured_differential
    chambers[:, 1::2] = 1013.0
    parts = {
        "t": log.time[:, None],
        "u": 0.01 * log.commanded_differential,
        "p": chambers,
        "theta": np.degrees(log.bend_angles),
        "tip": log.tip,
    }
    names = {
        key: [f"{key}{i}" for i in range(part.shape[1])] if key != "t" else ["t"]
        for key, part in parts.items()
    }
    header = ",".join(name for part in names.values() for name in part)
    values = np.concatenate(list(parts.values()), axis=1)
    np.savetxt(table, values, delimiter=",", header=header, comments="", fmt="%.8g")
    content = {
        "time": "t",
        "commanded": names["u"],
        "chambers": names["p"],
        "angles": names["theta"],
        "tip": names["tip"],
        "pressure_unit": "hPa",
        "angle_unit": "deg",
    }
    columns.write_text(yaml.safe_dump(content))
