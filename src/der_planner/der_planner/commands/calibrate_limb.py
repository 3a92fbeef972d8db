"""Identify a limb: run or read a calibration, fit, and write a limb file that every node takes.

    python3 scripts/calibrate_limb.py --offline --seed 3 --out my_twin.yaml
    python3 scripts/calibrate_limb.py --graph --seed 3 --out my_twin.yaml
    python3 scripts/calibrate_limb.py --graph --hardware my_rig.yaml --out my_limb.yaml
    python3 scripts/calibrate_limb.py calibrations/DATE/bag --out my_limb.yaml
    python3 scripts/calibrate_limb.py log.csv --columns map.yaml --mass 0.31 --out limb.yaml
    python3 scripts/calibrate_limb.py their_log.csv --out limb.yaml

--offline plays the calibration on the twin in one process, in seconds. --graph plays it in real
time on the running graph, on the twin or the hardware, records a bag, vents, and fits to the bag:
about four minutes. A log is a table or a bag of any run that excites every input; its last quarter
is kept back to judge the fit, unless there is --held-out or --weight. `--excitation FILE.csv`
writes the pressures of the calibration run, and `--play FILE.csv` plays such a file instead.

--mounting says how the limb was mounted in the log, --payload what it carried beside its own
masses: the payload belongs to the log and does not enter the limb file. --mass is what a scale
shows of the limb: the limb file weighs as much, and its stiffness and gains follow from that.

--weight KG --at M says that a known weight was hung on at a place along the limb, once it rested
after the run, for ten seconds or more: its stiffness is then known whatever friction does. With
--graph the limb rests for that at the end of the run. A limb on a plate is pulled across by a
thread over a pulley.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from pathlib import Path

import numpy as np

from der_planner.experiment.console import (
    OptionError,
    add_load_options,
    check_file,
    check_folder,
    check_limb_file,
    command,
    given_load,
)
from der_planner.experiment.processes import GraphError, Hardware, NodeError
from der_planner.files import write_whole
from der_planner.identification import (
    CalibrationLog,
    LogError,
    fit,
    predict,
    read_bag,
    read_log,
    record_twin,
)
from der_planner.identification.excitation import (
    AMPLITUDE,
    Excitation,
    calibration_run,
    read_excitation,
    within_limits,
    write_excitation,
)
from der_planner.identification.foreign import is_bag, is_ours
from der_planner.identification.log import prepare
from der_planner.identification.readers import ask_map, read_table
from der_planner.identification.report import plot_prediction
from der_planner.identification.stiffness import FREE, REST
from der_planner.identification.terms import GROUPS
from der_planner.limb import Limb, LimbError
from der_planner.model import CONTROL_PERIOD
from der_planner.planning.loads import nearly_buckling

LAST_PART = 0.25
"""Share of a LOG that is kept back to judge the fit."""


@command(LogError, LimbError, GraphError, NodeError, OSError, stopped="no limb file was written")
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line: 0 when a limb file was written, 1 after an error, 2 for bad options."""
    given = _options(parser)
    _check(given)
    load = given_load(given)
    bare = Limb.from_yaml(given.prior) if given.prior else Limb.default()
    try:
        prior = (bare if given.mass is None else bare.weighing(given.mass)).loaded(load)
        if given.weight is not None:
            prior.carrying(given.weight, given.at, name="weight")  # refuses what cannot hang there
    except LimbError as error:
        raise OptionError(str(error)) from error
    if given.excitation:
        run = _excitation(prior, prior.pneumatics.pressure_limit, given)
        write_excitation(run, given.excitation)
        print(f"{run.duration:.0f} s of excitation in {given.excitation}")
        return 0
    if said := nearly_buckling(prior):
        print(
            f"warning: with the stiffness and mass of the prior {said}. The fit says whether it "
            "is so with the stiffness that it finds",
            file=sys.stderr,
        )
    held_out = [read_log(path, given.columns, given.namespace) for path in given.held_out]
    log = _obtain(prior, given)
    kept_back = []
    if given.log is not None and not given.held_out and given.weight is None:
        log, rest = log.parted(LAST_PART)
        kept_back = [dataclasses.replace(rest, source=f"the end of {rest.source}, not shown")]
    terms = [*given.terms, *(["mass"] if given.fit_mass else [])]
    weight = None if given.weight is None else (given.weight, given.at)
    limb, report = fit(prior, log, terms=terms, longest_gap=given.longest_gap, weight=weight)
    if given.mass is not None:
        provenance = {**limb.provenance, "weighed_kg": given.mass}
        limb = dataclasses.replace(limb, provenance=provenance)
    unseen = [*kept_back, *held_out]
    # The payload, which was put on last, belongs to the log alone.
    kept = dataclasses.replace(limb, masses=limb.masses[:-1]) if load.payload else limb
    lines = [report.text(), *(_held_out_text(limb, each, given.longest_gap) for each in unseen)]
    text = "\n".join([*lines, _weight(kept, given)])
    print(text)
    kept.to_yaml(given.out)
    print(f"limb file: {given.out}")
    if given.report:
        write_whole(given.report / "report.txt", text + "\n")
        plot_prediction(limb, log, given.report / "prediction.png", *unseen[:1])
        print(f"report: {given.report}")
    return 0


def _options(parser: argparse.ArgumentParser) -> argparse.Namespace:
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--offline", action="store_true", help="calibrate the twin of --seed")
    source.add_argument(
        "--graph", action="store_true", help="play on the running graph, record a bag and fit to it"
    )
    source.add_argument(
        "log",
        type=Path,
        nargs="?",
        metavar="LOG",
        help="fit to a log of any program, a table or a bag; what cannot be known is asked once",
    )
    source.add_argument(
        "--excitation", type=Path, metavar="FILE", help="write the run's pressures as CSV and stop"
    )
    parser.add_argument(
        "--hardware", type=Path, metavar="FILE", help="with --graph: in place of the twin"
    )
    parser.add_argument(
        "--play", type=Path, metavar="FILE", help="pressures to play, a table as of --excitation"
    )
    parser.add_argument(
        "--folder",
        type=Path,
        help="with --graph: for bag, logs and report (default: calibrations/ and the time)",
    )
    parser.add_argument("--columns", type=Path, metavar="FILE", help="YAML map of tables' columns")
    parser.add_argument("--namespace", default="", help="of the limb, where a bag holds several")
    parser.add_argument("--prior", type=Path, help="limb file to start from (default: built in)")
    parser.add_argument("--seed", type=int, default=1, help="of the twin (default: 1)")
    parser.add_argument("--quick", action="store_true", help="90 s instead of 200 s of excitation")
    parser.add_argument(
        "--terms",
        type=_terms,
        default=",".join(GROUPS),
        help=f"model terms to fit, of {', '.join(GROUPS)}; 'none' for gain and rest angle alone",
    )
    add_load_options(parser)
    parser.add_argument(
        "--mass",
        type=float,
        metavar="KG",
        help="what the limb weighs from its clamp on, with fittings, tubes and tags and without "
        "the payload (without it: as the prior)",
    )
    parser.add_argument(
        "--fit-mass",
        action="store_true",
        help="fit the mass of each segment and keep the prior's stiffness, not the other way round",
    )
    parser.add_argument(
        "--weight",
        type=float,
        metavar="KG",
        help="weight that was hung on the resting limb after the run; needs --at",
    )
    parser.add_argument(
        "--at", type=float, metavar="M", help="where it was hung on, along the limb from its clamp"
    )
    parser.add_argument("--longest-gap", type=float, default=1.0, help="in the log, bridged [s]")
    parser.add_argument(
        "--held-out",
        type=Path,
        nargs="+",
        default=[],
        metavar="FILE",
        help="bags or tables to predict, not to fit",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("limb.yaml"),
        help="limb file to write (default: limb.yaml)",
    )
    parser.add_argument("--report", type=Path, help="folder for report.txt and prediction.png")
    return parser.parse_args()


def _terms(text: str) -> list[str]:
    """Return the model terms of --terms."""
    found = [] if text == "none" else text.split(",")
    for name in found:
        if name not in GROUPS:
            raise argparse.ArgumentTypeError(f"'{name}' is none of {', '.join(GROUPS)}")
    return found


def _check(given: argparse.Namespace) -> None:
    """Refuse options that do not go together, and results that cannot be written.

    Raises:
        OptionError: names the option and what it may be.
    """
    for wrong, said in (
        (given.weight == 0.0, "--weight is 0 kg: give what the weight weighs"),
        (given.hardware and not given.graph, "--hardware goes with --graph"),
        (given.folder and not given.graph, "--folder goes with --graph"),
        (
            given.play and not (given.graph or given.offline),
            "--play goes with --graph or --offline",
        ),
        (
            given.weight is not None and given.offline,
            "--weight goes with --graph or a LOG: nobody hangs a weight on the offline twin",
        ),
        (not 0 <= given.seed < 2**31, f"--seed is {given.seed}: choose 0 to {2**31 - 1}"),
        (
            given.mass is not None and given.fit_mass,
            "--fit-mass looks for the mass that --mass gives: choose one of the two",
        ),
        (
            (given.weight is None) != (given.at is None),
            "--weight KG and --at M go together: a weight, and where along the limb it was hung on",
        ),
    ):
        if wrong:
            raise OptionError(said)
    if given.excitation:
        check_file(given.excitation, "--excitation")
        return
    if given.graph:
        stamp = time.strftime("%Y-%m-%d_%H-%M-%S")
        given.folder = (given.folder or Path("calibrations") / stamp).resolve()
        given.report = given.report or given.folder / "report"
        check_folder(given.folder, "--folder")
        if (bag := given.folder / "bag").exists():
            raise OptionError(f"--folder has a bag already: name another one, or fit to {bag}")
    check_limb_file(given.out)
    if given.report:
        check_folder(given.report, "--report")


def _weight(limb: Limb, given: argparse.Namespace) -> str:
    """Say what the limb of the file weighs, and where that comes from."""
    weighs = f"mass: the limb weighs {1000 * limb.mass:.0f} g in its file"
    if given.mass is not None:
        return f"{weighs}, by --mass"
    if given.fit_mass:
        return f"{weighs}, as fitted"
    return f"{weighs}, as in the prior: it was not weighed (--mass KG)"


def _excitation(prior: Limb, pressure_limit: float, given: argparse.Namespace) -> Excitation:
    if given.play:
        return read_excitation(given.play, prior.segment_count)
    run = calibration_run(AMPLITUDE * pressure_limit, prior.segment_count, given.quick)
    if given.weight is None:
        return run
    at, end = run.duration + FREE, run.duration + REST
    said = f"hang {given.weight:g} kg on at {given.at:g} m, and leave it there"
    print(f"after {at:.0f} s, {said} until the run ends after {end:.0f} s", file=sys.stderr)
    now = f"  NOW {said} until the run ends in {REST - FREE:.0f} s"
    return dataclasses.replace(run.with_rest(REST), prompts={round(at / CONTROL_PERIOD): now})


def _obtain(prior: Limb, given: argparse.Namespace) -> CalibrationLog:
    """Play or read the log to fit to."""
    if given.graph:
        log = read_bag(_play_on_graph(prior, given))
        source = log.source if given.hardware else f"twin, seed {given.seed}, bag"
        return dataclasses.replace(log, source=source)
    if not given.offline:
        return read_log(given.log, _columns(given), given.namespace)
    limit = prior.pneumatics.pressure_limit
    run = within_limits(_excitation(prior, limit, given), limit, math.inf)
    print(f"playing {run.duration:.0f} s on the twin of seed {given.seed} …", file=sys.stderr)
    return record_twin(given.seed, run, limb=prior)


def _columns(given: argparse.Namespace) -> Path | None:
    """Return the map of the log's columns; where there is none yet, ask for it and keep it.

    Raises:
        LogError: the log cannot be read, or there is nobody to ask.
    """
    if given.columns is not None:
        return Path(given.columns)
    path = Path(f"{given.log}.columns.yaml")
    if path.exists():
        return path
    if is_bag(given.log) and is_ours(given.log):
        return None
    names = list(read_table(given.log, ()))
    if not sys.stdin.isatty():
        raise LogError(
            f"{given.log} needs {path}, a map of its columns {', '.join(names)}: run this in a "
            "terminal, and it asks"
        )
    ask_map(names, path)
    print(f"written: {path}")
    return path


def _play_on_graph(prior: Limb, given: argparse.Namespace) -> Path:
    """Play the calibration on the twin's nodes or the hardware; return the bag."""
    # ROS is imported only by who needs it.
    from der_planner.experiment.graph_trials import play_calibration  # noqa: PLC0415

    hardware = Hardware.from_yaml(given.hardware) if given.hardware else None
    driver = (hardware or Hardware()).limits
    limit = min(prior.pneumatics.pressure_limit, driver.pressure_limit)
    # Steps may be faster than the limb's own slew_limit, which is for plans: they show how the air
    # follows. The driver's limit holds for every setpoint.
    run = within_limits(_excitation(prior, limit, given), limit, driver.slew_limit)
    return play_calibration(run, given.folder, prior, given.seed, hardware)


def _held_out_text(limb: Limb, log: CalibrationLog, longest_gap: float) -> str:
    prepared = prepare(log, limb, longest_gap=longest_gap, to_fit=False)
    lines = [f"held out: {log.source}"]
    for model in ("der", "pcc"):
        predicted = predict(limb, prepared.log.time, prepared.pressure, model)
        error = np.degrees(predicted.bend_angles - prepared.log.bend_angles)
        span = np.degrees(np.ptp(prepared.bend, axis=0))
        rms = np.sqrt(np.nanmean(error**2, axis=0))
        parts = [
            f"segment {index} {value:.2f}° ({100 * value / width:.1f} % of its range of "
            f"{width:.1f}°)"
            for index, (value, width) in enumerate(zip(rms, span, strict=True))
        ]
        lines.append(f"  {model}: " + ", ".join(parts))
    return "\n".join(lines)
