"""What a recorded run shows of the limb: its smoothed motion and what the model lacks, with doubts.

    python3 scripts/estimate.py out/bags/same_direction_der_optimal_trial1 --limb FILE

FILE is the limb file that was planned with, of an experiment out/limbs/seed_1.yaml. Any bag of a
plan will do, played with feedback or without. The estimator of feedback goes over all
pictures and pressures of the run, forward and backward. The table (CSV) has a row every 50 ms: bend
angles and rates, tip, and per segment the effective pressure that the model lacks and the relative
error of its gain, each with its standard deviation. Exit code 0: written; 2: a file cannot be used.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from der_planner.arrays import Array
from der_planner.commands.learn import FAILURES, add_plan_options, in_hindsight, plan_of
from der_planner.estimation.hindsight import Smoothed, smooth
from der_planner.experiment.console import check_file, command
from der_planner.files import write_columns
from der_planner.results import RunSeries, load_run


@command(*FAILURES, code=2)
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="of a run")
    parser.add_argument("--out", type=Path, metavar="FILE", help="table (CSV) to write")
    add_plan_options(parser)
    parser.add_argument("--namespace", default="", help="of the limb, where a bag holds several")
    given = parser.parse_args()
    if given.out is not None:
        check_file(given.out)
    run = load_run(given.bag, namespace=given.namespace)
    smoothed = in_hindsight(smooth, plan_of(run, given), run)
    print("\n".join(_said(smoothed, run)))
    if given.out is not None:
        write_table(smoothed, given.out)
        print(given.out)
    return 0


def _said(smoothed: Smoothed, run: RunSeries) -> list[str]:
    """Return what there is to say of a run, a line each."""
    deviation = np.sqrt(np.trace(smoothed.tip_covariance, axis1=1, axis2=2).mean())
    seen = run.tip.known.time
    lines = [
        f"seen from {seen[0]:.1f} to {seen[-1]:.1f} s of {smoothed.time[-1]:.1f} s",
        f"tip known to {deviation * 1000:.2f} mm (standard deviation)",
        f"pictures against what was expected of them: {smoothed.innovation:.2f} of the variance",
    ]
    size = smoothed.bend_angle.shape[1]
    for i in range(size):
        missing, gain = smoothed.missing_pressure[:, i], smoothed.gain_error[:, i]
        lines.append(
            f"segment {i}: missing pressure {missing.mean():+.0f} Pa (from {missing.min():+.0f}"
            f" to {missing.max():+.0f}), gain error {gain.mean():+.1%}"
        )
    if run.truth is not None:
        told = smoothed.consistency(run.truth.time, run.truth.value)
        lines.append(f"true tip against the estimate: {told:.2f} of the variance")
    return lines


def write_table(smoothed: Smoothed, path: Path) -> None:
    """Write a smoothed run as CSV, units in the names of the columns."""
    size = smoothed.bend_angle.shape[1]
    tip_sigma = np.sqrt(np.diagonal(smoothed.tip_covariance, axis1=1, axis2=2))
    columns: dict[str, Array] = {"time_s": smoothed.time}
    columns |= {f"tip_{axis}_m": smoothed.tip[:, i] for i, axis in enumerate("xy")}
    columns |= {f"tip_{axis}_sigma_m": tip_sigma[:, i] for i, axis in enumerate("xy")}
    quantities = (
        ("bend_angle", "_rad", smoothed.bend_angle),
        ("bend_rate", "_rad_s", smoothed.bend_rate),
        ("missing_pressure", "_pa", smoothed.missing_pressure),
        ("gain_error", "", smoothed.gain_error),
    )
    for place, (name, unit, values) in enumerate(quantities):
        for i in range(size):
            columns[f"{name}_{i}{unit}"] = values[:, i]
            columns[f"{name}_{i}_sigma{unit}"] = smoothed.deviation[:, place * size + i]
    write_columns(path, columns)
