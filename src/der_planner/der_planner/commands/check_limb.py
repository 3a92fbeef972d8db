"""Say from any later run whether a limb file still fits.

    python3 scripts/check_limb.py out/bags/same_direction_der_1 --limb my_limb.yaml
    python3 scripts/check_limb.py log.csv --columns columns.yaml --limb my_limb.yaml

Predicts the run open loop from its measured pressures, for a limb that is mounted as --mounting
says (without it: as its file says) and carries a --payload in this run. Exit code 0: it fits; 3:
calibrate again; 1: the run or the file cannot be used.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from der_planner.experiment.load_options import add_load_options, as_loaded
from der_planner.identification import (
    ColumnMap,
    LogError,
    check,
    read_bag,
    read_csv,
)
from der_planner.limb import Limb, LimbError


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path, metavar="BAG", help="bag of the run, or a CSV table")
    parser.add_argument("--limb", type=Path, required=True, help="limb file to check")
    parser.add_argument("--columns", type=Path, help="YAML map of the table's columns")
    parser.add_argument(
        "--namespace",
        default="",
        metavar="NAME",
        help="of the limb, where a bag holds several",
    )
    add_load_options(parser)
    given = parser.parse_args()
    try:
        limb = as_loaded(Limb.from_yaml(given.limb), given)
        if given.run.suffix == ".csv":
            if given.columns is None:
                parser.error("a table needs --columns FILE")
            log = read_csv(given.run, ColumnMap.from_yaml(given.columns))
        else:
            log = read_bag(given.run, given.namespace)
        verdict = check(limb, log)
    except (LogError, LimbError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    print(verdict.text())
    return 0 if verdict.fits else 3
