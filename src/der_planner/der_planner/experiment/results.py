"""The end of an experiment: the table on the terminal, results.json and figures in the folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from der_planner.experiment.errors import GraphError
from der_planner.experiment.offline_run import load_arrays
from der_planner.experiment.options import Options, Trial
from der_planner.experiment.progress import Progress
from der_planner.results import (
    BagError,
    EvaluationError,
    RunSeries,
    compare,
    evaluate_run,
    format_table,
    load_run,
    plot_error,
    plot_learning,
    plot_pressures,
    plot_tip,
    summarise,
    write_report,
    write_results,
)

Kept = list[tuple[Trial, dict[str, Any]]]


def conclude(options: Options, kept: Kept, progress: Progress) -> Path:
    """Evaluate every trial from its bag alone, print the table, write results and figures.

    Args:
        options: of the experiment.
        kept: each trial with what the ledger holds of it.
        progress: shows what happens.

    Returns:
        The path of results.json.

    Raises:
        GraphError: a bag is missing or cannot be evaluated; the others are not lost.
    """
    progress.say("evaluating")
    runs = [load(options.out, trial, entry) for trial, entry in kept]
    found = [evaluate_run(run) for run in runs]
    path = write_results(found, options.out)
    print(format_table(summarise(found), compare(found)))
    _print_instruments(found, kept)
    figures = [
        path for plot in (plot_tip, plot_error, plot_pressures) for path in plot(runs, options.out)
    ]
    learned = plot_learning(found, options.out)
    figures += learned
    progress.say(f"results: {path}")
    if options.report:
        written = write_report(runs, found, options.out / "report", drawn=figures)
        progress.say(f"report: {written.page}")
    more = ", learning.png" if learned else ""
    progress.say(f"figures: {options.out}/tip.png, error.png, pressures.png{more}")
    return path


def load(folder: Path, trial: Trial, entry: dict[str, Any]) -> RunSeries:
    """Return a finished run of an experiment.

    Raises:
        GraphError: nothing was kept of it, or it cannot be read.
    """
    place = entry.get("bag") or entry.get("arrays")
    if place is None:
        raise GraphError(f"nothing was kept of {trial.name}: remove trials/{trial.name}.json")
    try:
        if "bag" in entry:
            # The bag may hold other limbs of the same ROS domain: the plan's id names ours.
            return load_run(folder / place, plan_id=entry.get("plan_id", trial.name))
        return load_arrays(folder / place)
    except (BagError, EvaluationError, OSError, json.JSONDecodeError) as error:
        raise GraphError(
            f"cannot evaluate {trial.name}: {error}. Remove {folder}/trials/{trial.name}.json to "
            "play it again"
        ) from error


def _print_instruments(found: list[Any], kept: Kept) -> None:
    """Say how well the instruments worked, where that can be known: in the twin's bags."""
    for result, (trial, entry) in zip(found, kept, strict=True):
        checks = {name: value for name, value in result.checks.items() if value is not None}
        if not checks and "cpu_percent" not in entry:
            continue
        print(f"\n{trial.name}")
        for name, value in checks.items():
            print(f"  {name.replace('_', ' '):<36} {value:.4g}")
        if entry.get("twin_real_time_factor") is not None:
            print(f"  {'twin, simulated over real seconds':<36} {entry['twin_real_time_factor']}")
        cpu = ", ".join(f"{name} {value:.0f}" for name, value in entry["cpu_percent"].items())
        print(f"  CPU in % of one core: {cpu}")
