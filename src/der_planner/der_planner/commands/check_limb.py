"""Say from later runs whether a limb file still fits, and bring it up to date.

    python3 scripts/check_limb.py out/bags/same_direction_der_optimal_trial1 --limb my_limb.yaml
    python3 scripts/check_limb.py log.csv --columns columns.yaml --limb my_limb.yaml
    python3 scripts/check_limb.py --update LATER_BAG --limb my_limb.yaml --out today.yaml

Predicts each run open loop from its measured pressures, for a limb that is mounted as --mounting
says (without it: as its file says) and carries a --payload in the runs. Exit code 0: it fits; 3:
calibrate again; 1: a run or the file cannot be used; 2: bad options.

With --update: gain, rest angle and friction are brought up to date from all runs together, ordinary
ones, as far as they tell them; the rest stays. Half a minute in which both segments move tells
all. --out names the new limb file; without it nothing is written.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

from der_planner.experiment.console import (
    OptionError,
    add_load_options,
    check_limb_file,
    command,
    given_load,
    loaded,
)
from der_planner.identification import CalibrationLog, LogError, check, read_log, update
from der_planner.limb import Limb, LimbError


@command(LogError, LimbError, OSError)
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line."""
    given = _options(parser)
    if given.out is not None:
        if not given.update:
            raise OptionError("--out is the updated limb file: give --update, too")
        check_limb_file(given.out)
    limb = Limb.from_yaml(given.limb)
    under_load = loaded(limb, given_load(given))
    if under_load.other_mounting:
        print(f"warning: {under_load.other_mounting}", file=sys.stderr)
    logs = [read_log(path, given.columns, given.namespace) for path in given.runs]
    if given.update:
        return _update(limb, under_load, logs, given.out)
    return max([_check(under_load, log, len(logs) > 1) for log in logs])


def _options(parser: argparse.ArgumentParser) -> argparse.Namespace:
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="BAG", help="bags of runs, or CSV tables"
    )
    parser.add_argument("--limb", type=Path, required=True, help="limb file to check")
    parser.add_argument("--columns", type=Path, metavar="FILE", help="YAML map of tables' columns")
    parser.add_argument("--namespace", default="", help="of the limb, where a bag holds several")
    parser.add_argument(
        "--update", action="store_true", help="bring gain, rest angle and friction up to date"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="updated limb file, a new one")
    add_load_options(parser)
    return parser.parse_intermixed_args()


def _check(limb: Limb, log: CalibrationLog, named: bool) -> int:
    verdict = check(limb, log)
    if named:
        print(f"{log.source}:")
    print(verdict.text())
    return 0 if verdict.fits else 3


def _update(limb: Limb, loaded: Limb, logs: list[CalibrationLog], out: Path | None) -> int:
    """Update a limb from runs in which it was loaded; write it with its own loads."""
    found, said = update(loaded, logs)
    print(said.text())
    if not said.told:
        print("nothing was told: the limb file stays as it is")
        return 0 if said.enough else 3
    if not said.enough:
        print("the limb file does not fit, and these three numbers do not mend it: calibrate again")
    elif out is None:
        print("nothing was written: name the updated limb file by --out FILE")
    else:
        dataclasses.replace(found, gravity=limb.gravity, masses=limb.masses).to_yaml(out)
        print(f"written: {out}")
    return 0 if said.enough else 3
