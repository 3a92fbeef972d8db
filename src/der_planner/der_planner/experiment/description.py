"""What an experiment is: checked and said before anything is started, and kept with each run."""

from __future__ import annotations

import contextlib
import math
import platform
import re
import subprocess
from pathlib import Path
from typing import Any

from der_planner.experiment.console import Progress
from der_planner.experiment.options import Options, Trial, TrialRun
from der_planner.limb import Limb, mounting_of
from der_planner.model import RodModel
from der_planner.planning import BucklingError, UnreachableError, Workspace
from der_planner.planning.paths import read_csv
from der_planner.results.evaluation import DRAWN

MOST_DRAWN = 500
"""So many points of a drawn path are kept for the figures."""


def check_motions(options: Options, left: list[Trial], limb: Limb) -> None:
    """Refuse what cannot be planned before anything is started.

    Raises:
        PlanningError: a motion's numbers, or a path that the limb cannot follow.
    """
    space = Workspace(RodModel(limb))
    # A twin that is still to be calibrated may reach what the default limb does not.
    open_yet = (BucklingError, UnreachableError) if options.calibrate else ()
    for name in dict.fromkeys(trial.motion for trial in left):
        with contextlib.suppress(*open_yet):
            options.motion(name).reference(space)


def other_twin(options: Options, limb: Limb, trials: list[Trial]) -> str:
    """Return a sentence where the limb file is of another twin than a trial's; else empty."""
    own = re.match(r"twin, seed (\d+)", str(limb.provenance.get("source", "")))
    if own is None or (options.hardware is not None and options.hardware.twin is None):
        return ""
    others = sorted({trial.seed for trial in trials} - {int(own[1])})
    if not others:
        return ""
    return (
        f"{options.limb} was calibrated on the twin of seed {own[1]}, trials play on the twin of "
        f"seed {', '.join(map(str, others))}, another limb: choose --seed {own[1]} and one trial, "
        "or leave --limb out, and each twin is calibrated"
    )


def stage(options: Options) -> str:
    """Say on what trials are played."""
    if options.hardware is not None and options.hardware.twin is None:
        return f"the hardware at {options.hardware.place}"
    return "the twin, offline" if options.offline else f"the twin, board {options.board}"


def describe(
    options: Options, trials: list[Trial], left: list[Trial], limb: Limb, progress: Progress
) -> None:
    """Say what would be done."""
    progress.say(f"limb: {limb.name}, {limb.segment_count} segments, {limb.length:.3f} m")
    progress.say(f"loads: {_loads(limb)}")
    if limb.other_mounting:
        progress.say(f"warning: {limb.other_mounting}")
    progress.say(f"stage: {stage(options)}")
    if options.hardware is not None:
        for name, values in vars(options.hardware).items():
            progress.say(f"  {name}: {values or 'as it is'}")
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


def metadata(run: TrialRun) -> dict[str, Any]:
    """Return what a run's bag or arrays say of it."""
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
        **_path_metadata(options),
        "limb": str(run.limb_file or "default"),
        "loads": _loads(run.limb),
        "stage": stage(options),
        "commit": commit or "unknown",
        "python": platform.python_version(),
        "machine": platform.node(),
    }


def _path_metadata(options: Options) -> dict[str, Any]:
    if options.path is None:
        return {}
    if not options.nearest:
        return {"path": str(options.path)}
    drawn = read_csv(options.path)[1]
    shown = drawn[:: math.ceil(len(drawn) / MOST_DRAWN)].round(5)
    return {"path": str(options.path), DRAWN: shown.tolist()}
