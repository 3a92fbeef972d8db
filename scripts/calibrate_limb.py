#!/usr/bin/env python3
"""Identify a limb: run or read a calibration, fit, and write a limb file that every node takes.

    python3 scripts/calibrate_limb.py --offline --seed 3 --out my_twin.yaml
    python3 scripts/calibrate_limb.py --bag out/bags/calibration --out my_limb.yaml
    python3 scripts/calibrate_limb.py --csv log.csv --columns columns.yaml --out my_limb.yaml

--offline plays the calibration on the twin in one process, in seconds. A bag is any recorded run
that excites every input; `--excitation FILE.csv` writes the pressures of the calibration run to
play.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import workspace

workspace.enter()

import numpy as np  # noqa: E402

from der_planner.identification import (  # noqa: E402
    CalibrationLog,
    ColumnMap,
    FitReport,
    LogError,
    calibration_run,
    fit,
    predict,
    read_bag,
    read_csv,
    record_twin,
)
from der_planner.identification.offline import AMPLITUDE  # noqa: E402
from der_planner.identification.parameters import GROUPS  # noqa: E402
from der_planner.identification.plots import plot_prediction  # noqa: E402
from der_planner.limb import Limb, LimbError  # noqa: E402


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--offline", action="store_true", help="calibrate the twin of --seed")
    source.add_argument("--bag", type=Path, help="fit to a recorded run")
    source.add_argument("--csv", type=Path, help="fit to a table; needs --columns")
    source.add_argument(
        "--excitation", type=Path, metavar="FILE", help="write the run's pressures as CSV and stop"
    )
    parser.add_argument("--columns", type=Path, help="YAML map of the table's columns")
    parser.add_argument("--prior", type=Path, help="limb file to start from (default: built in)")
    parser.add_argument("--seed", type=int, default=0, help="of the twin (default: 0)")
    parser.add_argument("--quick", action="store_true", help="90 s instead of 200 s of excitation")
    parser.add_argument(
        "--terms",
        default=",".join(GROUPS),
        help=f"model terms to fit, of {', '.join(GROUPS)}; 'none' for gain and rest angle alone",
    )
    parser.add_argument("--longest-gap", type=float, default=1.0, help="in the log, bridged [s]")
    parser.add_argument("--held-out", type=Path, help="bag or table to predict, not to fit")
    parser.add_argument("--out", type=Path, default=Path("limb.yaml"), help="limb file to write")
    parser.add_argument("--report", type=Path, help="folder for report.txt and prediction.png")
    given = parser.parse_args()
    if given.csv and not given.columns:
        parser.error("--csv needs --columns FILE")
    return given


def main() -> int:
    """Run the command line: 0 when a limb file was written, 1 after an error."""
    given = _arguments()
    try:
        prior = Limb.from_yaml(given.prior) if given.prior else Limb.default()
        amplitude = AMPLITUDE * prior.pneumatics.pressure_limit
        run = calibration_run(amplitude, prior.segment_count, given.quick)
        if given.excitation:
            table = np.column_stack([run.time, run.differential_pressure])
            names = [f"differential_pressure_{i}_Pa" for i in range(prior.segment_count)]
            header = ",".join(["time_s", *names])
            np.savetxt(given.excitation, table, delimiter=",", header=header, comments="", fmt="%g")
            print(f"{run.duration:.0f} s of excitation in {given.excitation}")
            return 0
        if given.offline:
            print(
                f"playing {run.duration:.0f} s on the twin of seed {given.seed} …", file=sys.stderr
            )
            log = record_twin(given.seed, run)
        else:
            log = _read(given.bag or given.csv, given.columns)
        terms = () if given.terms == "none" else given.terms.split(",")
        limb, report = fit(prior, log, terms=terms, longest_gap=given.longest_gap)
        held_out = _read(given.held_out, given.columns) if given.held_out else None
        _conclude(limb, report, log, held_out, given)
    except (LogError, LimbError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _read(path: Path, columns: Path | None) -> CalibrationLog:
    if path.suffix == ".csv":
        if columns is None:
            raise LogError(f"{path} needs --columns FILE")
        return read_csv(path, ColumnMap.from_yaml(columns))
    return read_bag(path)


def _conclude(
    limb: Limb,
    report: FitReport,
    log: CalibrationLog,
    held_out: CalibrationLog | None,
    given: argparse.Namespace,
) -> None:
    text = report.text()
    if held_out is not None:
        text += "\n" + _held_out_text(limb, held_out)
    print(text)
    given.out.parent.mkdir(parents=True, exist_ok=True)
    limb.to_yaml(given.out)
    print(f"limb file: {given.out}")
    if given.report:
        given.report.mkdir(parents=True, exist_ok=True)
        (given.report / "report.txt").write_text(text + "\n")
        plot_prediction(limb, log, given.report / "prediction.png", held_out)
        print(f"report: {given.report}")


def _held_out_text(limb: Limb, log: CalibrationLog) -> str:
    from der_planner.identification.prepare import prepare  # noqa: PLC0415

    prepared = prepare(log, limb)
    lines = [f"held out: {log.source}"]
    for model in ("der", "pcc"):
        predicted = predict(limb, prepared.log.time, prepared.pressure, model)
        error = np.degrees(predicted.bend_angles - prepared.log.bend_angles)
        span = np.degrees(np.ptp(prepared.bend, axis=0))
        rms = np.sqrt(np.nanmean(error**2, axis=0))
        parts = [
            f"segment {index} {value:.2f}° ({100 * value / width:.1f} % of its range)"
            for index, (value, width) in enumerate(zip(rms, span, strict=True))
        ]
        lines.append(f"  {model}: " + ", ".join(parts))
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
