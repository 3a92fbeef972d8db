"""Compute the tracking errors of recorded runs again, from their bags alone.

python3 scripts/evaluate.py out/bags/*
python3 scripts/evaluate.py out --report report           every bag of an experiment's folder
python3 scripts/evaluate.py out/bags/same_direction_der_1 --video film.mp4

A bag of several limbs gives a row for each: every limb is evaluated within its own namespace.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from der_planner.results import (
    BagError,
    EvaluationError,
    EvaluationSettings,
    compare,
    evaluate_bags,
    format_table,
    summarise,
    write_report,
    write_results,
)
from der_planner.results.errors import WINDOWS
from der_planner.results.outputs import OutputError, check_file, check_folder
from der_planner.results.overlay import write_video


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "bags", nargs="+", type=Path, metavar="BAG", help="bags, or experiment folders"
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="DIR",
        help="write report.html, results.json, table.{md,csv,tex} and the figures (PDF, PNG)",
    )
    parser.add_argument("--results", type=Path, metavar="DIR", help="write results.json only")
    parser.add_argument("--video", type=Path, metavar="FILE", help="overlay film of the first bag")
    parser.add_argument(
        "--window",
        choices=WINDOWS,
        default="plan",
        help="plan: every setpoint; cycles: without fade-in and closing move (default: plan)",
    )
    parser.add_argument(
        "--remove-lag",
        action="store_true",
        help="estimate a constant lag of each run and take it out before computing E",
    )
    return parser.parse_args()


def _check_outputs(options: argparse.Namespace) -> None:
    """Refuse what cannot be written before the bags are read."""
    for name in ("report", "results"):
        if getattr(options, name) is not None:
            check_folder(getattr(options, name), f"--{name}")
    if options.video is not None:
        check_file(options.video, "--video")


def expand(paths: list[Path]) -> list[Path]:
    """Replace the folder of an experiment by the bags in it."""
    found: list[Path] = []
    for path in paths:
        inside = path / "bags"
        is_experiment = inside.is_dir() and not (path / "metadata.yaml").exists()
        found += sorted(inside.iterdir()) if is_experiment else [path]
    return found


def _show(done: int, total: int, path: Path) -> None:
    if sys.stderr.isatty() or done == total:
        print(f"\r  {done} of {total} bags read, {path.name}", end="", file=sys.stderr, flush=True)
    if done == total:
        print(file=sys.stderr)


def _show_step(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


def main() -> int:
    """Run the command line; 0 when every bag was evaluated, 1 otherwise."""
    options = _arguments()
    try:
        _check_outputs(options)
    except OutputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    settings = EvaluationSettings(window=options.window, remove_lag=options.remove_lag)
    bags = expand(options.bags)
    found = evaluate_bags(bags, settings, _show)
    for entry in found:
        if entry.error:
            print(f"error: {entry.error}", file=sys.stderr)
    runs = [entry.run for entry in found if entry.run is not None]
    results = [entry.result for entry in found if entry.result is not None]
    if not results:
        return 1
    print(format_table(summarise(results), compare(results)))
    for result in results:
        if result.removed_lag_s:
            print(f"{result.bag}: a lag of {result.removed_lag_s * 1000:.0f} ms was taken out")
    try:
        if options.results is not None:
            print(write_results(results, options.results))
        if options.report is not None:
            print(write_report(runs, results, options.report, progress=_show_step).page)
        if options.video is not None:
            print(write_video(runs[0], options.video))
    except (BagError, EvaluationError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 1 if any(entry.error for entry in found) else 0
