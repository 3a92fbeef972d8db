#!/usr/bin/env python3
"""Compute the tracking errors of recorded runs again, from their bags alone.

python3 scripts/evaluate.py out/bags/*
python3 scripts/evaluate.py out/bags/* --report report
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import workspace

workspace.enter()

from der_planner.evaluation import (  # noqa: E402
    BagError,
    EvaluationError,
    RunSeries,
    Settings,
    compare,
    evaluate_run,
    format_table,
    load_run,
    plot_error,
    plot_pressures,
    plot_tip,
    summarise,
    write_results,
)


def main() -> int:
    """Run the command line; 0 when every bag was evaluated, 1 otherwise."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("bags", nargs="+", type=Path, metavar="BAG", help="bag folders or files")
    parser.add_argument("--out", type=Path, help="write results.json and the figures here")
    parser.add_argument("--window", choices=("plan", "cycles"), default="plan", help="what counts")
    parser.add_argument("--remove-lag", action="store_true", help="shift by the estimated lag")
    options = parser.parse_args()
    settings = Settings(window=options.window, remove_lag=options.remove_lag)
    runs: list[RunSeries] = []
    results = []
    failed = 0
    for path in options.bags:
        try:
            run = load_run(path)
            results.append(evaluate_run(run, settings))
            runs.append(run)
        except (BagError, EvaluationError) as error:
            print(f"error: {error}", file=sys.stderr)
            failed += 1
    if not results:
        return 1
    print(format_table(summarise(results), compare(results)))
    if options.out is not None:
        print(write_results(results, options.out))
        for plot in (plot_tip, plot_error, plot_pressures):
            for file in plot(runs, options.out):
                print(file)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
