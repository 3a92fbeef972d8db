"""How a command is told of recorded runs, and reads them: bags, or tables with a map of columns."""

from __future__ import annotations

import argparse
from pathlib import Path

from der_planner.identification import CalibrationLog, ColumnMap, LogError, read_bag, read_csv


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add --columns and --namespace."""
    parser.add_argument("--columns", type=Path, metavar="FILE", help="YAML map of tables' columns")
    parser.add_argument(
        "--namespace", default="", metavar="NAME", help="of the limb, where a bag holds several"
    )


def read_log(path: Path, given: argparse.Namespace) -> CalibrationLog:
    """Read a bag, or a table (CSV) by the map of --columns.

    Raises:
        LogError: it cannot be read, or is a table without a map.
    """
    if path.suffix != ".csv":
        return read_bag(path, given.namespace)
    if given.columns is None:
        raise LogError(f"{path} needs --columns FILE")
    return read_csv(path, ColumnMap.from_yaml(given.columns))
