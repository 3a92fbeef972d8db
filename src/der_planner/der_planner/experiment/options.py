"""The command line of an experiment: what is played, on what, how often, and where to."""

# ruff: noqa: RUF009 - `_option` returns a field

from __future__ import annotations

import argparse
import dataclasses
import itertools
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from der_planner.control.reaction import KINDS, Kind
from der_planner.experiment.console import OptionError, add_load_options, given_load
from der_planner.experiment.processes import Hardware
from der_planner.limb import Limb, Load
from der_planner.methods import LEARNED
from der_planner.model import Model, RodModel
from der_planner.planning import METHODS as METHODS_BY_MODEL
from der_planner.planning import Motion, Obstacles, Plan, PlanningError, plan
from der_planner.planning.motions import (
    DEFAULT_AMPLITUDE,
    DEFAULT_CYCLES,
    DEFAULT_PERIOD,
    JOINT_MOTIONS,
)
from der_planner.planning.motions import NAMES as MOTIONS
from der_planner.planning.planner import reference_and_configuration
from pressure_driver.protocols import NAMES as BOARDS

MODELS = tuple(METHODS_BY_MODEL)
METHODS = METHODS_BY_MODEL["der"]
DEFAULT_PAGE_PORT = 8080


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


def _option(default: Any, text: str, within: tuple[float, float] | None = None, **more: Any) -> Any:
    """Return the field of an option.

    Args:
        default: also tells the type of a number and that of a switch.
        text: for --help.
        within: the smallest and the largest value of a number.
        more: what argparse is told besides; ``flag``: the option's name if it is not the field's.
    """
    return field(default=default, metadata={"help": text, "within": within, **more})


def _place(kind: str, text: str) -> Any:
    """Return the field of an option that names a file or a folder, which --help calls ``kind``."""
    return _option(None, text, type=Path, metavar=kind)


@dataclass(frozen=True)
class Options:
    """A parsed and checked command line. Each field with a help text is an option."""

    motions: tuple[str, ...] = _option(
        ("same_direction",),
        "of %(choices)s; all: the first three, which are the paper's",
        nargs="+",
        choices=(*MOTIONS, "all"),
        metavar="MOTION",
    )
    path: Path | None = _place(
        "FILE.csv",
        "draw this path with the tip, in place of --motions: columns x, y and, if timed, time, "
        "with units as in 'time [s], x [cm], y [cm]' (default units: s and m)",
    )
    nearest: bool = _option(
        False, "follow the nearest path that the limb can follow where --path leaves its reach"
    )
    models: tuple[str, ...] = _option(
        MODELS, "of %(choices)s", nargs="+", choices=MODELS, metavar="MODEL"
    )
    method: str = _option("optimal", "of both models", choices=METHODS)
    learn: int = _option(
        0,
        "after each trial, up to N more runs, each of the plan that was learned from the ones "
        "before",
        (0, 100),
        metavar="N",
    )
    library: Path | None = _place(
        "FOLDER", "of learned plans: trials begin from the nearest one, if it is near"
    )
    trials: int = _option(1, "runs of each motion and model", (1, 1000))
    amplitude: float = _option(DEFAULT_AMPLITUDE, "largest bend of a segment [rad]", (0.01, 2.0))
    period: float = _option(DEFAULT_PERIOD, "of one cycle [s]", (0.5, 600.0))
    cycles: int = _option(DEFAULT_CYCLES, "cycles of the motion", (1, 1000))
    limb: Path | None = _place("FILE", "limb file; without it each twin is calibrated first")
    calibrate: bool = _option(
        True,
        "plan with the default limb file, as if the twin were that limb",
        flag="--no-calibration",
    )
    seed: int = _option(
        1, "of the first trial's twin; the next trial has the next seed", (0, 2**31 - 1000)
    )
    load: Load = Load()
    board: str = _option(BOARDS[0], "of the twin", choices=BOARDS)
    obstacles: Path | None = _place(
        "FILE", "what is in the limb's way (YAML): plans keep off it, and the twin runs into it"
    )
    hardware: Hardware | None = _place("FILE", "a real valve board and camera instead of the twin")
    offline: bool = _option(False, "without ROS, in one process, faster than real time")
    out: Path = _place(
        "DIR",
        "folder of bags, logs, figures and results.json; a folder that holds a stopped "
        "experiment goes on with it; without it: experiments/ and the time",
    )
    feedback: bool = _option(
        False, "play every plan of the rod twice: open loop, and corrected while it moves"
    )
    reaction: Kind = _option(
        "yield",
        "of feedback to what touches the limb; `yield` presses no harder than the plan",
        choices=KINDS,
    )
    force_limit: float = _option(
        0.0, "force [N] that `yield` allows, in place of the plan's; 0: the plan's", (0.0, 100.0)
    )
    page: int | None = _option(
        None,
        f"serve the operator's page from the first second until Ctrl-C after the last run, at port "
        f"{DEFAULT_PAGE_PORT} of this machine if none is given",
        (1, 65535),
        type=int,
        nargs="?",
        const=DEFAULT_PAGE_PORT,
        metavar="PORT",
    )
    poses: bool = _option(
        False, "simulated motion capture of rigid bodies in place of the twin's camera and tags"
    )
    record_images: bool = _option(False, "raw images into the bags, too")
    report: bool = _option(True, "skip figures and report at the end", flag="--no-report")
    dry_run: bool = _option(False, "say what would be done, start nothing")

    def motion(self, name: str) -> Motion:
        """Return the motion of a trial.

        Raises:
            PlanningError: the path's file has changed and cannot be read any more.
        """
        if self.path is not None:
            return Motion.from_csv(self.path, nearest=self.nearest)
        return Motion.named(name, amplitude=self.amplitude, period=self.period, cycles=self.cycles)

    @property
    def in_the_way(self) -> Obstacles | None:
        """What is in the limb's way.

        Raises:
            PlanningError: the file cannot be used.
        """
        return Obstacles.from_yaml(self.obstacles) if self.obstacles else None

    def check_motions(self, limb: Limb, trials: Sequence[Trial]) -> None:
        """Refuse what the limb cannot do before anything is started.

        Raises:
            PlanningError: numbers of a motion, a path that is out of reach, or obstacles in the
                way of either; another limb than a twin is.
        """
        twin = Limb.default()
        alike = limb.segment_count == twin.segment_count and 0.7 < limb.length / twin.length < 1.3
        if self.hardware is None and not alike:
            raise PlanningError(
                f"the twin has {twin.segment_count} segments and {twin.length:.3f} m, the limb "
                f"'{limb.name}' {limb.segment_count} and {limb.length:.3f} m: play on its own rig "
                "(--hardware), or on its own model by a study (task: model)"
            )
        rod = None if self.calibrate else RodModel(limb)
        for name, model in {(trial.motion, trial.model) for trial in trials}:
            motion = self.motion(name)
            if rod is None:  # what a limb reaches is known once it is calibrated
                if motion.path is not None:
                    motion.path.check_unit(limb.length)
            elif self.obstacles:  # only a plan tells whether there is a way past them
                plan(limb, motion, model, self.method, obstacles=self.in_the_way)
            else:
                body = rod if model == "der" else Model.of(limb, model)
                reference_and_configuration(motion, rod, body, None)

    def other_twin(self, limb: Limb) -> str:
        """Return a sentence where the limb file is of another twin than a trial's; else empty."""
        own = re.match(r"twin, seed (\d+)", str(limb.provenance.get("source", "")))
        if own is None or self.hardware or (int(own[1]), 1) == (self.seed, self.trials):
            return ""
        return (
            f"{self.limb} is of the twin of seed {own[1]}, trials play on twins from seed "
            f"{self.seed} on: give --seed {own[1]} --trials 1, or leave --limb out"
        )

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
        motion, trial = self.options.motion(self.trial.motion), self.trial
        return plan(self.limb, motion, trial.model, trial.method, obstacles=self.options.in_the_way)


def _add_options(parser: argparse.ArgumentParser) -> None:
    for each in dataclasses.fields(Options):
        if each.name == "load":
            add_load_options(parser)
            continue
        told = {key: value for key, value in each.metadata.items() if key != "within"}
        flag = told.pop("flag", f"--{each.name.replace('_', '-')}")
        if isinstance(each.default, bool):
            told["action"] = "store_false" if each.default else "store_true"
        elif each.default:
            shown = each.default if isinstance(each.default, tuple) else (each.default,)
            told["help"] += f" (default: {' '.join(map(str, shown))})"
        if isinstance(each.default, (int, float)) and "action" not in told:
            told["type"] = type(each.default)
        parser.add_argument(flag, dest=each.name, default=each.default, **told)


def parse(arguments: Sequence[str], parser: argparse.ArgumentParser | None = None) -> Options:
    """Parse and check a command line.

    Args:
        arguments: of the command line.
        parser: gets the options; None: one without a text for --help.

    Raises:
        OptionError: a number out of range, an unreadable file, or options that do not go together.
        SystemExit: after --help, or when argparse itself refuses, as an unknown name.
    """
    parser = parser or argparse.ArgumentParser()
    _add_options(parser)
    given = parser.parse_args(arguments)
    values: dict[str, Any] = {}
    for each in dataclasses.fields(Options):
        value = values[each.name] = getattr(given, each.name, None)
        within = each.metadata.get("within")
        if within and value is not None and not within[0] <= value <= within[1]:
            name, (least, most) = each.name.replace("_", "-"), within
            text = each.metadata["help"]
            raise OptionError(f"--{name} is {value}: choose {least} to {most} ({text})")
    load = given_load(given)
    motions = _motions(given)
    models = tuple(dict.fromkeys(given.models))
    hardware = Hardware.from_yaml(given.hardware) if given.hardware else None
    limb = given.limb or (Path(hardware.limb) if hardware and hardware.limb else None)
    real = hardware is not None and hardware.twin is None
    for wrong, said in (
        (given.nearest and given.path is None, "--nearest is about a path: give --path FILE.csv"),
        (
            given.page is not None and given.offline,
            "--page shows a running graph: it does not go with --offline",
        ),
        (
            given.record_images and given.offline,
            "--record-images is about bags: it does not go with --offline, which films nothing",
        ),
        (
            hardware is not None and given.offline,
            "--offline simulates everything: it does not go with --hardware",
        ),
        (
            given.board != BOARDS[0] and (given.offline or real),
            "--board is about the twin's nodes: not for --offline; a file of --hardware names its "
            "own as driver.protocol",
        ),
        (
            given.poses and (given.offline or real),
            "--poses is motion capture of the twin: it goes with neither --offline nor --hardware "
            "(a hardware file has the key poses)",
        ),
        (
            real and limb is None,
            "--hardware needs a limb file: --limb FILE (scripts/calibrate_limb.py)",
        ),
        (
            given.feedback and "der" not in models,
            "--feedback corrects plans of the rod: choose --models der",
        ),
        (
            not given.feedback and (given.force_limit or given.reaction != "yield"),
            "--reaction and --force-limit are about feedback: add --feedback",
        ),
        (
            given.force_limit and given.reaction != "yield",
            "--force-limit is what the reaction yield allows: leave --reaction out",
        ),
        (
            given.library is not None and not given.library.is_dir(),
            f"--library {given.library} is no folder: name one of learned plans",
        ),
    ):
        if wrong:
            raise OptionError(said)
    values |= {"motions": motions, "models": models, "load": load, "hardware": hardware}
    values |= {"limb": limb, "calibrate": limb is None and given.calibrate}
    if given.path is not None:
        # A path has neither amplitude nor period: the plan says so in the same way.
        values |= {"amplitude": 0.0, "period": 0.0, "cycles": 1, "path": given.path.resolve()}
    out = given.out or Path("experiments") / time.strftime("%Y-%m-%d_%H-%M-%S")
    values["out"] = out.resolve()
    for name in ("library", "obstacles"):
        if values[name] is not None:
            values[name] = values[name].resolve()
    options = Options(**values)
    try:
        options.in_the_way  # noqa: B018 - it is read
    except PlanningError as error:
        raise OptionError(f"--obstacles: {error}") from error
    return options


def _motions(given: argparse.Namespace) -> tuple[str, ...]:
    """Return the names of the motions; of a path, the name of its file.

    Raises:
        OptionError: the path cannot be read, or motions are asked for beside it.
    """
    if given.path is None:
        named = [JOINT_MOTIONS if each == "all" else (each,) for each in given.motions]
        return tuple(dict.fromkeys(itertools.chain(*named)))
    if isinstance(given.motions, list):  # the default is a tuple
        raise OptionError("--path is drawn in place of --motions: give one of the two")
    try:
        Motion.from_csv(given.path, nearest=given.nearest)
    except PlanningError as error:
        raise OptionError(f"--path: {error}") from error
    return (re.sub(r"[^A-Za-z0-9-]+", "_", given.path.stem).strip("_") or "path",)
