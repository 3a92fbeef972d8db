"""A whole experiment: calibrate each twin, play every trial, evaluate, write the results."""

from __future__ import annotations

import math
import platform
import subprocess
import time
from pathlib import Path
from typing import Any

from der_planner.experiment import results
from der_planner.experiment.errors import OptionError
from der_planner.experiment.ledger import Ledger
from der_planner.experiment.options import Options, Trial
from der_planner.experiment.progress import Progress
from der_planner.limb import Limb, LimbError, mounting_of
from der_planner.methods import LEARNED
from der_planner.results.outputs import check_folder


def run(options: Options) -> None:
    """Play what the options say and leave results.json, figures, bags and logs in the folder.

    Raises:
        OptionError: the limb file is not usable, or the folder holds another experiment.
        OutputError: the folder cannot be written.
        GraphError, NodeError: a trial failed; finished trials stay finished.
    """
    progress = Progress()
    limb = _check_limb(options)
    trials = options.plan_of_trials()
    ledger = Ledger(options)
    left = [trial for trial in trials if not _whole(trial, options, ledger)]
    check_folder(options.out)
    if options.dry_run:
        _describe(options, trials, left, limb, progress)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    progress.say(
        f"{len(left)} of {len(trials)} trials to play on {_stage(options)}, into {options.out}"
    )
    for place, trial in enumerate(trials, start=1):
        if trial not in left:
            continue
        progress.say(
            f"[{place}/{len(trials)}] {trial.motion}, {trial.model} {trial.manner}, "
            f"trial {trial.number} (seed {trial.seed})"
        )
        if ledger.finished(trial) is None:
            begun = _begin(trial, options, progress) if options.library is not None else None
            ledger.record(trial, _play(trial, options, progress, begun))
        if options.learn:
            _learn(trial, options, ledger, progress)
    kept = [(run, entry) for trial in trials for run, entry in _runs_of(trial, ledger)]
    results.conclude(options, kept, progress)


def _whole(trial: Trial, options: Options, ledger: Ledger) -> bool:
    """Tell whether a trial was played, and learned from as often as is asked for."""
    runs = len(_runs_of(trial, ledger))
    return runs > options.learn


def _runs_of(trial: Trial, ledger: Ledger) -> list[tuple[Trial, dict[str, Any]]]:
    """Return the finished runs of a trial, the learned ones after the first."""
    found, run = [], trial
    while (entry := ledger.finished(run)) is not None:
        found.append((run, entry))
        run = run.following()
    return found


def _learn(trial: Trial, options: Options, ledger: Ledger, progress: Progress) -> None:
    """Play what was learned from the runs before, again and again; finished runs stay finished."""
    # The learner brings the optimiser along, which an experiment without it need not wait for.
    from der_planner.experiment.learning import TrialLearning  # noqa: PLC0415

    limb = _limb_file(trial, options, progress)
    robot = options.loaded(Limb.from_yaml(limb) if limb is not None else Limb.default())
    learning = TrialLearning(trial, options, robot, progress)
    run = trial
    while True:
        entry = ledger.finished(run)
        if entry is None:
            progress.say(f"  run {run.run} of {options.learn + 1}")
            entry = _play(run, options, progress, learning.next(run.name))
            ledger.record(run, entry)
        learning.take(results.load(options.out, run, entry))
        if learning.stopped or run.run > options.learn:
            break
        run = run.following()
    learning.conclude()


def _begin(trial: Trial, options: Options, progress: Progress) -> Path | None:
    """Return the file of the plan that begins from a near learned one; None: there is none."""
    from der_planner.experiment.learning import begin_from_library  # noqa: PLC0415

    limb = _limb_file(trial, options, progress)
    robot = options.loaded(Limb.from_yaml(limb) if limb is not None else Limb.default())
    return begin_from_library(trial, options, robot, progress)


def _check_limb(options: Options) -> Limb:
    """Return the limb of the file, or the default one, under the loads of the experiment.

    Raises:
        OptionError: the file cannot be used, or the payload is not on the limb.
    """
    try:
        limb = Limb.from_yaml(options.limb) if options.limb is not None else Limb.default()
        return options.loaded(limb)
    except LimbError as error:
        raise OptionError(str(error)) from error


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
    if options.path is not None:
        progress.say(f"{len(left)} trials along {options.path}; nothing was started")
        return
    each = options.period * options.cycles
    progress.say(f"{len(left)} trials of {each:.0f} s motion each; nothing was started")


def _play(
    trial: Trial, options: Options, progress: Progress, learned: Path | None = None
) -> dict[str, Any]:
    limb = _limb_file(trial, options, progress)
    robot = options.loaded(Limb.from_yaml(limb) if limb is not None else Limb.default())
    metadata = _metadata(trial, options, limb, robot)
    if learned is not None and trial.run == 1:
        metadata["begun_from"] = str(options.library)
        metadata["method"] = metadata["method"].replace(trial.method, LEARNED, 1)
    if options.offline:
        # ROS-free: the other branch is imported only where it is used.
        from der_planner.experiment.offline_run import play_offline  # noqa: PLC0415

        return play_offline(trial, options, robot, metadata, progress, learned)
    from der_planner.experiment.graph_run import GraphTrial  # noqa: PLC0415

    played = GraphTrial(trial, options, limb, robot, metadata, progress, learned).play()
    return {
        "bag": str(played.bag.relative_to(options.out)),
        "plan_id": played.plan_id,
        "cpu_percent": {name: round(value, 1) for name, value in played.cpu_percent.items()},
        "twin_real_time_factor": None
        if math.isnan(played.real_time_factor)
        else round(played.real_time_factor, 3),
    }


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


def _loads(limb: Limb) -> str:
    masses = [f"{m.name} {m.mass * 1000:.4g} g at {m.arc_length:.3f} m" for m in limb.masses]
    return ", ".join([mounting_of(limb.gravity), *masses])


def _metadata(trial: Trial, options: Options, limb: Path | None, robot: Limb) -> dict[str, Any]:
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
        "limb": str(limb) if limb else "default",
        "loads": _loads(robot),
        "stage": _stage(options),
        "commit": _commit(),
        "python": platform.python_version(),
        "machine": platform.node(),
    }


def _commit() -> str:
    result = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    )
    return result.stdout.strip() or "unknown"
