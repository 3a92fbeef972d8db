"""Play motions on the limb or its twin and report the tracking error: the main command.

    python3 scripts/run_experiment.py        (Case 2, same_direction, DER and PCC, one trial each)
    python3 scripts/run_experiment.py --motions all --method optimal --trials 5
    python3 scripts/run_experiment.py --offline --motions all --trials 5
    python3 scripts/run_experiment.py --hardware my_rig.yaml --limb my_limb.yaml

Sets up what is missing first (ROS 2, Python packages, the nodes); --help shows every option.
Who plays differs: the nodes of the graph, which leave a bag, or this process, which leaves arrays.
Everything else is one path.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from der_planner.commands.learn import add_run, learning_summary
from der_planner.control import Learner, LearningError
from der_planner.experiment.console import (
    OptionError,
    Progress,
    alone_in,
    check_folder,
    command,
    interrupt_once,
    loaded,
)
from der_planner.experiment.offline_run import load_arrays, play_offline
from der_planner.experiment.options import Options, Trial, TrialRun, parse
from der_planner.experiment.processes import GraphError, NodeError
from der_planner.files import write_whole
from der_planner.identification import LogError, calibrate_twin
from der_planner.limb import Limb, LimbError, Load, mounting_of
from der_planner.methods import LEARNED
from der_planner.planning import PlanningError
from der_planner.planning.correction import carried_over, nearest
from der_planner.planning.loads import nearly_buckling
from der_planner.planning.plan_file import read_plan, write_plan
from der_planner.results import (
    BagError,
    EvaluationError,
    RunResult,
    RunSeries,
    compare,
    evaluate_run,
    format_table,
    load_run,
    summarise,
    write_report,
    write_results,
)
from der_planner.results.evaluation import DRAWN
from der_planner.results.report import instrument_table

Kept = list[tuple[Trial, dict[str, Any]]]
"""Finished runs, each with what the ledger holds of it."""
FAILURES = (GraphError, NodeError, PlanningError, LearningError, LogError, OSError)
"""What may end an experiment before its last trial."""
SAME = (
    "amplitude",
    "period",
    "cycles",
    "calibrate",
    "offline",
    "poses",
    "board",
    "reaction",
    "force_limit",
)
"""Options that an experiment which goes on must share with the stopped one."""
SAME_FILES = ("limb", "path", "obstacles")
"""Options whose files must have the same content."""


@command(*FAILURES, stopped="the same --out goes on from here")
def main(parser: argparse.ArgumentParser) -> int:
    """Run the command line; 0 when every trial was played, 1 after an error, 2 for bad options."""
    options = parse(sys.argv[1:], parser)
    if not options.offline:
        interrupt_once()
    if options.page is None or options.dry_run:
        run(options)
        return 0
    # ROS is imported only by who needs it.
    from der_planner.experiment.graph_run import experiment_page  # noqa: PLC0415

    progress = Progress()
    check_folder(options.out)
    with experiment_page(options, progress) as page:
        try:
            run(options, progress)
            progress.say("done; the page stays with the report until Ctrl-C")
        except FAILURES as error:
            progress.fail(f"{error}; the page stays until Ctrl-C")
        if not page.alive:
            progress.say(f"warning: {page.failure('died')}")
        with contextlib.suppress(KeyboardInterrupt):
            while page.alive:
                time.sleep(0.5)
    return 1 if progress.failed else 0


def run(options: Options, progress: Progress | None = None) -> None:
    """Play what the options say and leave results.json, figures, bags and logs in the folder.

    Raises:
        OptionError: the limb file is not usable; the folder is not, or is of another experiment.
        PlanningError, LearningError: a motion cannot be planned, or cannot be learned.
        GraphError, NodeError: a trial failed; finished trials stay finished.
    """
    progress = progress or Progress()
    try:
        limb = _read(options.limb).loaded(options.load)
    except LimbError as error:
        raise OptionError(str(error)) from error
    trials = options.plan_of_trials()
    ledger = Ledger(options)
    left = [trial for trial in trials if len(ledger.runs_of(trial)) <= options.learn]
    check_folder(options.out)
    options.check_motions(limb, left)
    for said in filter(None, [limb.other_mounting, options.other_twin(limb)]):
        progress.say(f"warning: {said}")
    if options.dry_run:
        _describe(options, trials, left, limb, progress)
        return
    progress.say(
        f"{len(left)} of {len(trials)} trials to play on {_stage(options)}, into {options.out}"
    )
    with alone_in(options.out):
        for place, trial in enumerate(trials, start=1):
            if trial in left:
                progress.say(
                    f"[{place}/{len(trials)}] {trial.motion}, {trial.model} {trial.manner}, "
                    f"trial {trial.number} (seed {trial.seed})"
                )
                _play_trial(trial, options, ledger, progress)
        _conclude(options, [each for trial in trials for each in ledger.runs_of(trial)], progress)


class Ledger:
    """What of an experiment is done: a small file for each run, so that a stopped one goes on.

    Args:
        options: of the experiment; a finished run counts only if it was played with the same.
    """

    def __init__(self, options: Options) -> None:
        self._folder = options.out / "trials"
        self._settings = {
            **{name: getattr(options, name) for name in SAME},
            **{f"{name}_sha256": _digest(getattr(options, name)) for name in SAME_FILES},
            **options.load._asdict(),
            "hardware": options.hardware.place if options.hardware else "",
            "library": str(options.library or ""),
        }

    def finished(self, trial: Trial) -> dict[str, Any] | None:
        """Return what `record` kept of a run, or None if it is still to be played.

        Raises:
            OptionError: the folder holds this run played with other options.
        """
        path = self._folder / f"{trial.name}.json"
        if not path.exists():
            return None
        kept = json.loads(path.read_text())
        for key, value in {**self._settings, "seed": trial.seed}.items():
            found = kept["settings"].get(key)
            if found != value:
                raise OptionError(
                    f"{path.parent.parent} holds {trial.name} with {key} = {found}, not {value}: "
                    "choose another --out"
                )
        return dict(kept["result"])

    def runs_of(self, trial: Trial) -> Kept:
        """Return the finished runs of a trial, the learned ones after the first."""
        found, following = [], trial
        while (entry := self.finished(following)) is not None:
            found.append((following, entry))
            following = following.following()
        return found

    def record(self, trial: Trial, result: dict[str, Any]) -> None:
        """Keep the result of a finished run."""
        settings = {**self._settings, "seed": trial.seed}
        text = json.dumps({"settings": settings, "result": result}, indent=1)
        write_whole(self._folder / f"{trial.name}.json", text)


def _digest(path: Path | None) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path is not None else ""


# Playing -----------------------------------------------------------------------------------------


def _play_trial(trial: Trial, options: Options, ledger: Ledger, progress: Progress) -> None:
    """Play a trial, and then what is learned from it; finished runs are not played again."""
    limb = _limb_file(trial, options, progress)
    first = TrialRun(trial, options, limb, loaded(_read(limb), options.load))
    if ledger.finished(trial) is None:
        ledger.record(trial, _play(first, progress))
    if not options.learn:
        return
    begun = _plan_file(options, trial.name)
    learner = Learner(read_plan(begun) if begun.exists() else first.plan())
    following = trial
    while True:
        entry = ledger.finished(following)
        if entry is None:
            progress.say(f"  run {following.run} of {options.learn + 1}")
            learned = _write_next(learner, following, options, following.name)
            entry = _play(first._replace(trial=following, learned=learned), progress)
            ledger.record(following, entry)
        add_run(learner, _load(options.out, following, entry))
        last = learner.history[-1]
        progress.say(
            f"  run {last.number}: mean error {last.mean_error * 100:.3f} cm; {last.reason}"
        )
        if learner.stopped or following.run > options.learn:
            break
        following = following.following()
    name = f"{trial.motion}_{trial.model}_trial{trial.number}"
    path = _write_next(learner, trial, options, name)
    reason = learner.stopped or "learning can go on from here"
    progress.say(f"  {reason}; the plan to go on with: {path}")


def _plan_file(options: Options, name: str) -> Path:
    return options.out / "learned" / f"{name}.yaml"


def _write_next(learner: Learner, trial: Trial, options: Options, name: str) -> Path:
    """Write the plan to play next under a name, and return its file."""
    path = _plan_file(options, name)
    summary = learning_summary(learner)
    write_plan(learner.next(), path, {"seed": trial.seed, "trial": trial.number, **summary})
    return path


def _begin_from(library: Path, run: TrialRun, progress: Progress) -> Path | None:
    """Write the plan of a first run that begins from a near learned one, and return its file.

    None: no learned plan in the library is near.
    """
    fresh = run.plan()
    found = nearest(library, fresh)
    if found is None:
        progress.say(f"  no learned plan in {library} is near this motion")
        return None
    file, learned = found
    path = _plan_file(run.options, run.trial.name)
    write_plan(carried_over(fresh, learned), path, {"begun_from": str(file)})
    progress.say(f"  begins from what was learned in {file}")
    return path


def _play(run: TrialRun, progress: Progress) -> dict[str, Any]:
    """Play one run on the graph or in this process; return what the ledger keeps of it."""
    about, library = _metadata(run), run.options.library
    if run.learned is None and library is not None:
        run = run._replace(learned=_begin_from(library, run, progress))
        if run.learned is not None:
            about["begun_from"] = str(library)
            about["method"] = about["method"].replace(run.trial.method, LEARNED, 1)
    run = run._replace(metadata=about)
    if run.options.offline:
        return play_offline(run, progress)
    # ROS is imported only by who needs it.
    from der_planner.experiment.graph_trials import play_on_graph  # noqa: PLC0415

    return play_on_graph(run, progress)


def _limb_file(trial: Trial, options: Options, progress: Progress) -> Path | None:
    """Return the limb file to plan with; the twin of a new seed is calibrated first."""
    if not options.calibrate:
        return options.limb
    mounting = f"_{options.load.mounting}" if options.load.mounting else ""
    path = options.out / "limbs" / f"seed_{trial.seed}{mounting}.yaml"
    if path.exists():
        return path
    prior = Limb.default().loaded(Load(mounting=options.load.mounting))
    if said := nearly_buckling(prior):
        progress.say(f"  warning: with the stiffness and mass of the default limb {said}")
    progress.say(f"  calibrating on the twin of seed {trial.seed}: {path}")
    limb, _ = calibrate_twin(trial.seed, prior)
    limb.to_yaml(path)
    return path


def _read(limb: Path | None) -> Limb:
    return Limb.from_yaml(limb) if limb is not None else Limb.default()


def _stage(options: Options) -> str:
    if options.hardware is not None and options.hardware.twin is None:
        return f"the hardware at {options.hardware.place}"
    return "the twin, offline" if options.offline else f"the twin, board {options.board}"


def _describe(
    options: Options, trials: list[Trial], left: list[Trial], limb: Limb, progress: Progress
) -> None:
    """Say what would be done."""
    size = f"{limb.segment_count} segments, {limb.length:.3f} m"
    progress.say(f"limb: {limb.name}, {size}, {_loads(limb)}")
    progress.say(f"stage: {_stage(options)}")
    progress.say(f"into: {options.out}")
    for trial in trials:
        state = "to play" if trial in left else "done"
        progress.say(f"  {trial.name}  seed {trial.seed}  {state}")
    if options.calibrate:
        progress.say("what is in reach and free of obstacles is known once the limb is calibrated")
    progress.say(f"{len(left)} trials; nothing was started")


def _loads(limb: Limb) -> str:
    masses = [f"{m.name} {m.mass * 1000:.4g} g at {m.arc_length:.3f} m" for m in limb.masses]
    return ", ".join([mounting_of(limb.gravity), *masses])


def _metadata(run: TrialRun) -> dict[str, Any]:
    trial, options = run.trial, run.options
    path = options.motion(trial.motion).path if options.nearest else None
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip()
    return {
        "motion": trial.motion,
        "model": trial.model,
        "method": trial.manner,
        "trial": trial.number,
        **({"learned_from": trial.run - 1} if trial.run > 1 else {}),
        "seed": trial.seed,
        "amplitude_rad": options.amplitude,
        "period_s": options.period,
        "cycles": options.cycles,
        **({"path": str(options.path)} if options.path is not None else {}),
        **({DRAWN: path.tip[:: 1 + len(path.tip) // 500].round(5).tolist()} if path else {}),
        "limb": str(run.limb_file or "default"),
        "loads": _loads(run.limb),
        "stage": _stage(options),
        "commit": commit or "unknown",
        "python": platform.python_version(),
        "machine": platform.node(),
    }


# The end -----------------------------------------------------------------------------------------


def _conclude(options: Options, kept: Kept, progress: Progress) -> None:
    """Evaluate every run from what it left, print the table, write results and report.

    Raises:
        GraphError: a bag is missing or cannot be evaluated; the others are not lost.
    """
    progress.say("evaluating")
    runs = [_load(options.out, trial, entry) for trial, entry in kept]
    found = [evaluate_run(run) for run in runs]
    written = {"results": write_results(found, options.out)}
    if options.report:
        written["figures and report"] = write_report(runs, found, options.out / "report")
    print(format_table(summarise(found), compare(found)))
    _print_instruments(found, kept)
    for what, path in written.items():
        progress.say(f"{what}: {path}")


def _load(folder: Path, trial: Trial, entry: dict[str, Any]) -> RunSeries:
    """Return a finished run of an experiment.

    Raises:
        GraphError: what was kept of it cannot be read.
    """
    try:
        if "arrays" in entry:
            return load_arrays(folder / entry["arrays"])
        # The bag may hold other limbs of the same ROS domain: the plan's id names ours.
        return load_run(folder / entry["bag"], plan_id=entry.get("plan_id", trial.name))
    except (BagError, EvaluationError, OSError, json.JSONDecodeError) as error:
        again = f"{folder}/trials/{trial.name}.json to play it again"
        raise GraphError(f"cannot evaluate {trial.name}: {error}. Remove {again}") from error


def _print_instruments(found: list[RunResult], kept: Kept) -> None:
    """Say how well the instruments worked, where that can be known: in the twin's bags."""
    if (instruments := instrument_table(found)).rows:
        print(f"\n{instruments.text()}")
    for trial, entry in kept:
        if (speed := entry.get("twin_real_time_factor")) is not None:
            print(f"{trial.name}: the twin ran at {speed} of real time")
