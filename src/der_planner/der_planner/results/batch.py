"""Many bags at once, read by as many processes as there are cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from der_planner.bags.reader import BagError
from der_planner.bags.record import read_record
from der_planner.bags.run import EvaluationError, RunSeries
from der_planner.bags.series import run_of
from der_planner.results.alignment import Settings
from der_planner.results.metrics import RunResult, evaluate_run

WORTH_WHILE = 64 << 20
"""Bags of fewer bytes in total are read by one process."""


@dataclass(frozen=True)
class Evaluated:
    """One limb of one bag: its run and result, or the reason why there is none."""

    path: Path
    run: RunSeries | None = None
    result: RunResult | None = None
    error: str = ""


def evaluate_bags(
    paths: Sequence[Path],
    settings: Settings | None = None,
    *,
    workers: int = 0,
    progress: Callable[[int, int, Path], None] | None = None,
) -> list[Evaluated]:
    """Evaluate bags in parallel; one that fails does not stop the others.

    Args:
        paths: bag folders or files.
        settings: for all of them.
        workers: processes; 0 = as many as there are cores, but only this one for so few bytes that
            starting others would take longer; 1 = this process.
        progress: called with the number done, the number of bags and the last one's path.

    Returns:
        One entry per limb that has a plan, in the order of the paths; one with the reason for a
        bag without any.
    """
    chosen = settings or Settings()
    workers = min(workers or _worth_while(paths), len(paths))
    if workers <= 1:
        found = []
        for count, path in enumerate(paths, start=1):
            found += _evaluate(path, chosen)
            if progress is not None:
                progress(count, len(paths), path)
        return found
    done: dict[Path, list[Evaluated]] = {}
    # Forking a process that already runs threads (ROS, BLAS) can deadlock.
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        waiting = {pool.submit(_evaluate, path, chosen): path for path in paths}
        for count, future in enumerate(as_completed(waiting), start=1):
            path = waiting[future]
            done[path] = future.result()
            if progress is not None:
                progress(count, len(paths), path)
    return [entry for path in paths for entry in done[path]]


def _worth_while(paths: Sequence[Path]) -> int:
    """Return how many processes pay for their start of a few seconds."""
    files = [file for path in paths for file in (path.glob("*") if path.is_dir() else [path])]
    size = sum(file.stat().st_size for file in files if file.is_file())
    return os.cpu_count() or 1 if size > WORTH_WHILE else 1


def _evaluate(path: Path, settings: Settings) -> list[Evaluated]:
    try:
        record = read_record(path)
    except (BagError, OSError) as error:
        return [Evaluated(path, error=str(error))]
    found = []
    for namespace in sorted(record.played or record.limbs) or [""]:
        try:
            run = run_of(record, namespace)
            found.append(Evaluated(path, run, evaluate_run(run, settings)))
        except (BagError, EvaluationError, OSError) as error:
            found.append(Evaluated(path, error=str(error)))
    return found
