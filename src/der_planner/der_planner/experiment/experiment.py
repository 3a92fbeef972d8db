"""A whole experiment: calibrate each twin, play every trial, evaluate, write the results.

Who plays differs: the nodes of the graph, which leave a bag, or this process, which leaves arrays.
Everything else is one path.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

from der_planner.experiment.console import OptionError, Progress
from der_planner.experiment.offline_run import load_arrays, play_offline
from der_planner.experiment.options import Options, Trial, TrialRun
from der_planner.experiment.processes import GraphError
from der_planner.limb import Limb, LimbError, mounting_of
from der_planner.methods import LEARNED
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
from der_planner.results.outputs import check_folder

Kept = list[tuple[Trial, dict[str, Any]]]
"""Finished runs, each with what the ledger holds of it."""


def run(options: Options) -> None:
    """Play what the options say and leave results.json, figures, bags and logs in the folder.

    Raises:
        OptionError: the limb file is not usable, or the folder holds another experiment.
        OutputError: the folder cannot be written.
        GraphError, NodeError: a trial failed; finished trials stay finished.
    """
    progress = Progress()
    try:
        limb = options.loaded(_read(options.limb))
    except LimbError as error:
        raise OptionError(str(error)) from error
    trials = options.plan_of_trials()
    ledger = Ledger(options)
    left = [trial for trial in trials if len(ledger.runs_of(trial)) <= options.learn]
    check_folder(options.out)
    if options.dry_run:
        _describe(options, trials, left, limb, progress)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    progress.say(
        f"{len(left)} of {len(trials)} trials to play on {_stage(options)}, into {options.out}"
    )
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
            "amplitude": options.amplitude,
            "period": options.period,
            "cycles": options.cycles,
            "limb_sha256": _digest(options.limb),
            "path_sha256": _digest(options.path),
            "mounting": options.mounting,
            "payload": options.payload or "",
            "payload_at": options.payload_at or "",
            "calibrate": options.calibrate,
            "offline": options.offline,
            "hardware": options.hardware.driver.get("port") if options.hardware else "",
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
            found = kept["settings"].get(key, "")
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
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._folder / f"{trial.name}.json"
        unfinished = path.with_suffix(".part")
        settings = {**self._settings, "seed": trial.seed}
        unfinished.write_text(json.dumps({"settings": settings, "result": result}, indent=1))
        os.replace(unfinished, path)


def _digest(path: Path | None) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path is not None else ""


# Playing -----------------------------------------------------------------------------------------


def _play_trial(trial: Trial, options: Options, ledger: Ledger, progress: Progress) -> None:
    """Play a trial, and then what is learned from it; finished runs are not played again."""
    limb = _limb_file(trial, options, progress)
    first = TrialRun(trial, options, limb, options.loaded(_read(limb)))
    if ledger.finished(trial) is None:
        ledger.record(trial, _play(first, progress))
    if not options.learn:
        return
    # The learner brings the optimiser along, which an experiment without it need not wait for.
    from der_planner.experiment.learning import TrialLearning  # noqa: PLC0415

    learning = TrialLearning(first, progress)
    following = trial
    while True:
        entry = ledger.finished(following)
        if entry is None:
            progress.say(f"  run {following.run} of {options.learn + 1}")
            learned = learning.next(following.name)
            entry = _play(first._replace(trial=following, learned=learned), progress)
            ledger.record(following, entry)
        learning.add(_load(options.out, following, entry))
        if learning.stopped or following.run > options.learn:
            break
        following = following.following()
    learning.conclude()


def _play(run: TrialRun, progress: Progress) -> dict[str, Any]:
    """Play one run on the graph or in this process; return what the ledger keeps of it."""
    about = _metadata(run)
    if run.learned is None and run.options.library is not None:
        from der_planner.experiment.learning import begin_from_library  # noqa: PLC0415

        run = run._replace(learned=begin_from_library(run, progress))
        if run.learned is not None:
            about["begun_from"] = str(run.options.library)
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
    mounting = f"_{options.mounting}" if options.mounting else ""
    path = options.out / "limbs" / f"seed_{trial.seed}{mounting}.yaml"
    if path.exists():
        return path
    from der_planner.identification import calibrate_twin  # noqa: PLC0415
    from der_planner.planning.loads import nearly_buckling  # noqa: PLC0415

    prior = options.mounted(Limb.default())
    if said := nearly_buckling(prior):
        progress.say(f"  warning: with the stiffness and mass of the default limb {said}")
    progress.say(f"  calibrating on the twin of seed {trial.seed}")
    begin = time.monotonic()
    limb, _ = calibrate_twin(trial.seed, prior)
    path.parent.mkdir(parents=True, exist_ok=True)
    limb.to_yaml(path)
    progress.say(f"  calibrated in {time.monotonic() - begin:.1f} s: {path}")
    return path


def _read(limb: Path | None) -> Limb:
    return Limb.from_yaml(limb) if limb is not None else Limb.default()


def _stage(options: Options) -> str:
    if options.hardware is not None:
        return f"the hardware at {options.hardware.driver['port']}"
    return "the twin, offline" if options.offline else "the twin"


def _describe(
    options: Options, trials: list[Trial], left: list[Trial], limb: Limb, progress: Progress
) -> None:
    """Say what would be done."""
    progress.say(f"limb: {limb.name}, {limb.segment_count} segments, {limb.length:.3f} m")
    progress.say(f"loads: {_loads(limb)}")
    if limb.other_mounting:
        progress.say(f"warning: {limb.other_mounting}")
    progress.say(f"stage: {_stage(options)}")
    if options.hardware is not None:
        for node in ("driver", "tracker", "planner", "recorder"):
            progress.say(f"  {node}: {getattr(options.hardware, node) or 'defaults'}")
        progress.say(f"  remapped: {options.hardware.remap or 'nothing'}")
    progress.say(f"into: {options.out}")
    for trial in trials:
        state = "to play" if trial in left else "done"
        progress.say(f"  {trial.name}  seed {trial.seed}  {state}")
    each = f"of {options.period * options.cycles:.0f} s motion each"
    where = each if options.path is None else f"along {options.path}"
    progress.say(f"{len(left)} trials {where}; nothing was started")


def _loads(limb: Limb) -> str:
    masses = [f"{m.name} {m.mass * 1000:.4g} g at {m.arc_length:.3f} m" for m in limb.masses]
    return ", ".join([mounting_of(limb.gravity), *masses])


def _metadata(run: TrialRun) -> dict[str, Any]:
    trial, options = run.trial, run.options
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
        "limb": str(run.limb_file or "default"),
        "loads": _loads(run.limb),
        "stage": _stage(options),
        "commit": commit or "unknown",
        "python": platform.python_version(),
        "machine": platform.node(),
    }


# The end -----------------------------------------------------------------------------------------


def _conclude(options: Options, kept: Kept, progress: Progress) -> None:
    """Evaluate every run from what it left, print the table, write results and figures.

    Raises:
        GraphError: a bag is missing or cannot be evaluated; the others are not lost.
    """
    progress.say("evaluating")
    runs = [_load(options.out, trial, entry) for trial, entry in kept]
    found = [evaluate_run(run) for run in runs]
    path = write_results(found, options.out)
    print(format_table(summarise(found), compare(found)))
    _print_instruments(found, kept)
    for plot in (plot_tip, plot_error, plot_pressures):
        plot(runs, options.out)
    learned = plot_learning(found, options.out)
    progress.say(f"results: {path}")
    if options.report:
        written = write_report(runs, found, options.out / "report")
        progress.say(f"report: {written.page}")
    more = ", learning.png" if learned else ""
    progress.say(f"figures: {options.out}/tip.png, error.png, pressures.png{more}")


def _load(folder: Path, trial: Trial, entry: dict[str, Any]) -> RunSeries:
    """Return a finished run of an experiment.

    Raises:
        GraphError: nothing was kept of it, or it cannot be read.
    """
    again = f"{folder}/trials/{trial.name}.json to play it again"
    if "bag" not in entry and "arrays" not in entry:
        raise GraphError(f"nothing was kept of {trial.name}: remove {again}")
    try:
        if "arrays" in entry:
            return load_arrays(folder / entry["arrays"])
        # The bag may hold other limbs of the same ROS domain: the plan's id names ours.
        return load_run(folder / entry["bag"], plan_id=entry.get("plan_id", trial.name))
    except (BagError, EvaluationError, OSError, json.JSONDecodeError) as error:
        raise GraphError(f"cannot evaluate {trial.name}: {error}. Remove {again}") from error


def _print_instruments(found: list[Any], kept: Kept) -> None:
    """Say how well the instruments worked, where that can be known: in the twin's bags."""
    for result, (trial, entry) in zip(found, kept, strict=True):
        if "cpu_percent" not in entry:
            continue
        print(f"\n{trial.name}")
        for name, value in result.checks.items():
            if value is not None:
                print(f"  {name.replace('_', ' '):<36} {value:.4g}")
        if entry.get("twin_real_time_factor") is not None:
            print(f"  {'twin, simulated over real seconds':<36} {entry['twin_real_time_factor']}")
        cpu = ", ".join(f"{name} {value:.0f}" for name, value in entry["cpu_percent"].items())
        print(f"  CPU in % of one core: {cpu}")
