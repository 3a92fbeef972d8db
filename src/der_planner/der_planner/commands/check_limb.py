"""Say from later runs whether a limb file still fits, and bring it up to date.

    python3 scripts/check_limb.py out/bags/same_direction_der_1 --limb my_limb.yaml
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

from der_planner.commands.log_options import add_log_options, read_log
from der_planner.experiment.console import OptionError, add_load_options, as_loaded, check_loads
from der_planner.identification import (
    CalibrationLog,
    LogError,
    check,
    update,
)
from der_planner.limb import Limb, LimbError
from der_planner.results.outputs import OutputError, check_file


def main() -> int:
    """Run the command line."""
    parser = _parser()
    given = parser.parse_intermixed_args()
    if given.out is not None and not given.update:
        parser.error("--out is the updated limb file: give --update, too")
    if given.columns is None and any(path.suffix == ".csv" for path in given.runs):
        parser.error("a table needs --columns FILE")
    try:
        check_loads(given)
        limb = Limb.from_yaml(given.limb)
        if given.out is not None:
            _check_new(given.out)
        loaded = as_loaded(limb, given)
        if loaded.other_mounting:
            print(f"warning: {loaded.other_mounting}", file=sys.stderr)
        logs = [read_log(path, given) for path in given.runs]
        if given.update:
            return _update(limb, loaded, logs, given.out)
        return max([_check(loaded, log, len(logs) > 1) for log in logs])
    except OptionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (LogError, LimbError, OutputError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "runs", nargs="+", type=Path, metavar="BAG", help="bags of runs, or CSV tables"
    )
    parser.add_argument("--limb", type=Path, required=True, help="limb file to check")
    add_log_options(parser)
    parser.add_argument(
        "--update", action="store_true", help="bring gain, rest angle and friction up to date"
    )
    parser.add_argument("--out", type=Path, metavar="FILE", help="updated limb file, a new one")
    add_load_options(parser)
    return parser


def _check_new(path: Path) -> None:
    """Refuse a limb file that is there already.

    Raises:
        OutputError: it is, or it cannot be written there.
    """
    check_file(path)
    if path.exists():
        raise OutputError(f"--out {path} is there already: name a new file, limb files are kept")


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
        out.parent.mkdir(parents=True, exist_ok=True)
        dataclasses.replace(found, gravity=limb.gravity, masses=limb.masses).to_yaml(out)
        print(f"written: {out}")
    return 0 if said.enough else 3
