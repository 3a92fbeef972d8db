"""Compute the tracking errors of recorded runs again, from their bags alone.

python3 scripts/evaluate.py out/bags/*
python3 scripts/evaluate.py out --report report           every bag of an experiment's folder
python3 scripts/evaluate.py out/bags/same_direction_der_optimal_trial1 --video film.mp4
python3 scripts/evaluate.py out/bags/same_direction_der_optimal_trial1 --contact --limb FILE

FILE is the limb file that was planned with, of an experiment out/limbs/seed_1.yaml. An experiment
with --offline has no bags: its runs are in out/runs.

A bag of several limbs gives a row for each: every limb is evaluated within its own namespace.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from der_planner.commands.learn import FAILURES, add_plan_options, in_hindsight, plan_of
from der_planner.estimation.hindsight import touches
from der_planner.experiment.console import Progress, check_file, check_folder, command
from der_planner.results import (
    RunSeries,
    compare,
    evaluate_bags,
    format_table,
    summarise,
    write_report,
    write_results,
)
from der_planner.results.overlay import write_video


def _options(parser: argparse.ArgumentParser) -> argparse.Namespace:
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
    parser.add_argument(
        "--video",
        type=Path,
        metavar="FILE",
        help="film of the first bag: .mp4, or .webp for a page",
    )
    parser.add_argument(
        "--contact",
        action="store_true",
        help="tell what touched the limb of --limb or --plan: when, where, with what force",
    )
    add_plan_options(parser, needed=False)
    given = parser.parse_args()
    if given.contact != bool(given.limb or given.plan):
        parser.error("--contact goes with --limb FILE or --plan FILE")
    return given


def expand(paths: list[Path]) -> list[Path]:
    """Replace the folder of an experiment by the bags in it."""
    found: list[Path] = []
    for path in paths:
        inside = path / "bags"
        is_experiment = inside.is_dir() and not (path / "metadata.yaml").exists()
        found += sorted(inside.iterdir()) if is_experiment else [path]
    return found


@command(*FAILURES)
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line; 0 when every bag was evaluated, 1 otherwise."""
    given = _options(parser)
    for name in ("report", "results"):
        if getattr(given, name) is not None:
            check_folder(getattr(given, name), f"--{name}")
    if given.video is not None:
        check_file(given.video, "--video")
    progress, bags, found = Progress(), expand(given.bags), []
    for entry in evaluate_bags(bags):
        found.append(entry)
        progress.bar(bags.index(entry.path) + 1, len(bags), entry.path.name, unit="bags read")
        if entry.error:
            progress.say(f"error: {entry.error}")
    runs = [entry.run for entry in found if entry.run is not None]
    results = [entry.result for entry in found if entry.result is not None]
    if not results:
        return 1
    print(format_table(summarise(results), compare(results)))
    if given.results is not None:
        print(write_results(results, given.results))
    if given.report is not None:
        print(write_report(runs, results, given.report, progress=progress.say))
    if given.video is not None:
        given.video.parent.mkdir(parents=True, exist_ok=True)
        print(write_video(runs[0], given.video))
    for run in runs if given.contact else ():
        print("\n".join([f"{run.description.title}:", *_touched(run, given)]))
    return 1 if any(entry.error for entry in found) else 0


def _touched(run: RunSeries, given: argparse.Namespace) -> list[str]:
    """Return what touched the limb in a run, a line each."""
    return [
        f"touched from {each.since:.2f} to {end:.2f} s, surest at {each.time:.2f} s: {each.said}"
        for each, end in in_hindsight(touches, plan_of(run, given), run)
    ] or ["nothing touched the limb"]
