"""The command line of an experiment: what is played, on what, how often, and where to."""

from __future__ import annotations

import argparse
import dataclasses
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from der_planner.experiment.console import OptionError, add_load_options, check_loads
from der_planner.experiment.processes import Hardware
from der_planner.limb import Limb
from der_planner.methods import LEARNED
from der_planner.planning import METHODS as METHODS_BY_MODEL
from der_planner.planning import Motion, Plan, PlanningError, plan
from der_planner.planning.motions import (
    DEFAULT_AMPLITUDE,
    DEFAULT_CYCLES,
    DEFAULT_PERIOD,
    JOINT_MOTIONS,
)
from der_planner.planning.motions import NAMES as MOTIONS

MODELS = tuple(METHODS_BY_MODEL)
METHODS = METHODS_BY_MODEL["der"]
DEFAULT_PAGE_PORT = 8080
DEFAULT_MOTIONS = ("same_direction",)
RANGES = (
    ("trials", 1, 1000),
    ("learn", 0, 100),
    ("cycles", 1, 1000),
    ("seed", 0, 2**31 - 1000),
    ("period", 0.5, 600.0),
    ("amplitude", 0.01, 2.0),
    ("page", 1, 65535),
)
"""The options that are numbers, each with its smallest and its largest value."""


@dataclass(frozen=True)
class Trial:
    """One run of one motion under one model.

    Attributes:
        motion: one of MOTIONS, or the name of the file of a path.
        model, method: names, see MODELS, METHODS.
        number: of the trial, from 1.
        seed: of the twin; the same for every motion and model of a trial.
        run: of the trial, from 1; those after the first play what was learned from the ones before.
        feedback: the commands are corrected while they are played.
    """

    motion: str
    model: str
    method: str
    number: int
    seed: int
    feedback: bool = False
    run: int = 1

    @property
    def name(self) -> str:
        """Name of the bag and of every other file of this run."""
        method = f"{self.method}_feedback" if self.feedback else self.method
        name = f"{self.motion}_{self.model}_{method}_trial{self.number}"
        return name if self.run == 1 else f"{name}_run{self.run}"

    def following(self) -> Trial:
        """Return the next run, which plays the plan that was learned."""
        return dataclasses.replace(self, method=LEARNED, run=self.run + 1)

    @property
    def manner(self) -> str:
        """The method, and if there is feedback: what tables call it."""
        return f"{self.method} + feedback" if self.feedback else self.method


@dataclass(frozen=True)
class Options:
    """A parsed and checked command line; see `parser` for what each means."""

    motions: tuple[str, ...]
    models: tuple[str, ...]
    method: str
    trials: int
    amplitude: float
    period: float
    cycles: int
    limb: Path | None
    calibrate: bool
    seed: int
    out: Path
    hardware: Hardware | None
    offline: bool
    dry_run: bool
    record_images: bool
    report: bool
    path: Path | None = None
    nearest: bool = False
    page: int | None = None
    learn: int = 0
    library: Path | None = None
    feedback: bool = False
    mounting: str = ""
    payload: float = 0.0
    payload_at: float | None = None

    def mounted(self, limb: Limb) -> Limb:
        """Return a limb as it is mounted here, without the payload: what is calibrated.

        Raises:
            LimbError: the mounting is unknown.
        """
        return limb.mounted(self.mounting) if self.mounting else limb

    def loaded(self, limb: Limb) -> Limb:
        """Return a limb as it is mounted here, with the payload: what is planned and played.

        Raises:
            LimbError: the mounting is unknown, or the payload is not on the limb.
        """
        return self.mounted(limb).carrying(self.payload, self.payload_at)

    def motion(self, name: str) -> Motion:
        """Return the motion of a trial.

        Raises:
            PlanningError: the path's file has changed and cannot be read any more.
        """
        if self.path is not None:
            return Motion.from_csv(self.path, nearest=self.nearest)
        return Motion.named(name, amplitude=self.amplitude, period=self.period, cycles=self.cycles)

    def plan_of_trials(self) -> list[Trial]:
        """Return every trial in the order in which they are played."""
        return [
            Trial(motion, model, self.method, number, self.seed + number - 1, feedback)
            for motion in self.motions
            for number in range(1, self.trials + 1)
            for model in self.models
            for feedback in ((False, True) if self.feedback and model == "der" else (False,))
        ]


class TrialRun(NamedTuple):
    """One run that is to be played, on the graph or offline.

    Attributes:
        trial, options: what to play.
        limb_file: to plan with; None for the default limb.
        limb: the same under the loads of the experiment; the twin is mounted and loaded as it is.
        metadata: kept with what the run leaves.
        learned: file of a learned plan, which is played in place of a new one.
    """

    trial: Trial
    options: Options
    limb_file: Path | None
    limb: Limb
    metadata: dict[str, Any] = {}  # noqa: RUF012 - never changed
    learned: Path | None = None

    def plan(self) -> Plan:
        """Plan the motion without anything learned.

        Raises:
            PlanningError: it cannot be planned.
        """
        motion = self.options.motion(self.trial.motion)
        return plan(self.limb, motion, model=self.trial.model, method=self.trial.method)


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Names the default of an option, unless that is nothing, off or zero."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        return super()._get_help_string(action) if action.default else action.help


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    result = argparse.ArgumentParser(
        prog="run_experiment.py",
        description="Play motions on the limb (or its twin) and report the tracking error.",
        epilog="Without options: Case 2 (same_direction), DER and PCC, one trial each, on the twin",
        formatter_class=_Help,
    )
    _add_motions(result.add_argument_group("what is played"))
    _add_stage(result.add_argument_group("on what"))
    _add_manner(result.add_argument_group("how"))
    return result


def _add_motions(what: argparse._ArgumentGroup) -> None:
    what.add_argument(
        "--motions",
        nargs="+",
        metavar="MOTION",
        help=f"of {', '.join(MOTIONS)}; all: the first three, which are the paper's (default: "
        f"{' '.join(DEFAULT_MOTIONS)})",
    )
    what.add_argument(
        "--path",
        type=Path,
        metavar="FILE.csv",
        help="draw this path with the tip, in place of --motions: columns x, y and, if timed, "
        "time, with units as in 'time [s], x [cm], y [cm]' (default units: s and m)",
    )
    what.add_argument(
        "--nearest",
        action="store_true",
        help="follow the nearest path that the limb can follow where --path leaves its reach",
    )
    what.add_argument(
        "--models", nargs="+", default=list(MODELS), metavar="MODEL", help=f"of {', '.join(MODELS)}"
    )
    what.add_argument(
        "--method", default="optimal", help=f"of {', '.join(METHODS)}, for both models"
    )
    what.add_argument(
        "--learn",
        type=int,
        default=0,
        metavar="N",
        help="after each trial, up to N more runs, each of the plan that was learned "
        "from the ones before",
    )
    what.add_argument(
        "--library",
        type=Path,
        metavar="FOLDER",
        help="of learned plans: trials begin from the nearest one, if it is near",
    )
    what.add_argument("--trials", type=int, default=1, help="runs of each motion and model")
    what.add_argument(
        "--amplitude", type=float, default=DEFAULT_AMPLITUDE, help="largest bend of a segment [rad]"
    )
    what.add_argument("--period", type=float, default=DEFAULT_PERIOD, help="of one cycle [s]")
    what.add_argument("--cycles", type=int, default=DEFAULT_CYCLES, help="cycles of the motion")


def _add_stage(where: argparse._ArgumentGroup) -> None:
    where.add_argument(
        "--limb",
        type=Path,
        metavar="FILE",
        help="limb file; without it each twin is calibrated first",
    )
    where.add_argument(
        "--no-calibration",
        action="store_true",
        help="plan with the default limb file, as if the twin were that limb",
    )
    where.add_argument(
        "--seed",
        type=int,
        default=1,
        help="of the first trial's twin; the next trial has the next seed",
    )
    add_load_options(where)
    where.add_argument(
        "--hardware",
        type=Path,
        metavar="FILE",
        help="a real valve board and camera instead of the twin",
    )


def _add_manner(how: argparse._ArgumentGroup) -> None:
    how.add_argument(
        "--offline", action="store_true", help="without ROS, in one process, faster than real time"
    )
    how.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder of bags, logs, figures and results.json; a folder that holds a stopped "
        "experiment goes on with it; without it: experiments/ and the time",
    )
    how.add_argument(
        "--feedback",
        action="store_true",
        help="play every plan of the rod twice: open loop, and corrected while it moves",
    )
    how.add_argument(
        "--page",
        type=int,
        nargs="?",
        const=DEFAULT_PAGE_PORT,
        metavar="PORT",
        help=f"serve the operator's page while the graph runs, at port {DEFAULT_PAGE_PORT} of this "
        "machine if none is given",
    )
    how.add_argument("--record-images", action="store_true", help="raw images into the bags, too")
    how.add_argument("--no-report", action="store_true", help="skip the HTML report at the end")
    how.add_argument("--dry-run", action="store_true", help="say what would be done, start nothing")


def parse(arguments: Sequence[str]) -> Options:
    """Parse and check a command line.

    Raises:
        OptionError: an unknown name, a number out of range or an unreadable file; says the choices.
        SystemExit: after --help, or when argparse itself refuses.
    """
    given = parser().parse_args(arguments)
    motions = _motions(given)
    models = tuple(dict.fromkeys(given.models))
    if given.path is None:
        _check_names("motion", motions, (*MOTIONS, "all"))
    _check_names("model", models, MODELS)
    _check_names("method", (given.method,), METHODS)
    for name, least, most in RANGES:
        value = getattr(given, name)
        if value is not None and not least <= value <= most:
            raise OptionError(f"--{name} is {value}: choose {least} to {most}")
    check_loads(given)
    hardware = Hardware.from_yaml(given.hardware) if given.hardware else None
    limb = given.limb or (Path(hardware.limb) if hardware and hardware.limb else None)
    for wrong, said in (
        (given.nearest and given.path is None, "--nearest is about a path: give --path FILE.csv"),
        (
            given.page is not None and given.offline,
            "--page shows a running graph: it does not go with --offline",
        ),
        (
            hardware is not None and given.offline,
            "--offline simulates everything: it does not go with --hardware",
        ),
        (
            hardware is not None and limb is None,
            "--hardware needs a limb file: --limb FILE (scripts/calibrate_limb.py)",
        ),
        (
            given.feedback and "der" not in models,
            "--feedback corrects plans of the rod: choose --models der",
        ),
        (
            given.library is not None and not given.library.is_dir(),
            f"--library {given.library} is no folder: name one of learned plans",
        ),
    ):
        if wrong:
            raise OptionError(said)
    out = given.out or Path("experiments") / time.strftime("%Y-%m-%d_%H-%M-%S")
    as_given = {
        field.name: getattr(given, field.name)
        for field in dataclasses.fields(Options)
        if hasattr(given, field.name)
    }
    if given.path is not None:
        # A path has neither amplitude nor period: the plan says so in the same way.
        as_given |= {"amplitude": 0.0, "period": 0.0, "cycles": 1, "path": given.path.resolve()}
    return Options(
        **as_given
        | {
            "motions": motions,
            "models": models,
            "limb": limb,
            "calibrate": limb is None and not given.no_calibration,
            "hardware": hardware,
            "out": out.resolve(),
            "report": not given.no_report,
            "library": given.library.resolve() if given.library is not None else None,
        }
    )


def _motions(given: argparse.Namespace) -> tuple[str, ...]:
    """Return the names of the motions; of a path, the name of its file.

    Raises:
        OptionError: the path cannot be read, or motions are asked for beside it.
    """
    if given.path is None:
        named = given.motions or DEFAULT_MOTIONS
        return JOINT_MOTIONS if list(named) == ["all"] else tuple(dict.fromkeys(named))
    if given.motions:
        raise OptionError("--path is drawn in place of --motions: give one of the two")
    try:
        Motion.from_csv(given.path, nearest=given.nearest)
    except PlanningError as error:
        raise OptionError(f"--path: {error}") from error
    return (re.sub(r"[^A-Za-z0-9-]+", "_", given.path.stem).strip("_") or "path",)


def _check_names(kind: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise OptionError(f"unknown {kind} '{name}': choose of {', '.join(known)}")
