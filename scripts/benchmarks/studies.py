"""What a study costs beside its runs: speed-up, memory of a worker."""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import time
from pathlib import Path

import psutil
from distributed import Client

from benchmarks import show
from der_planner.experiment.console import Progress
from der_planner.studies.conduct import PlaySettings, conduct, local_cluster
from der_planner.studies.study import Study

Figures = dict[str, float | str]

_RUNS = """
task: run
factors: {{seed: {{first: 1, count: {count}}}, calibration: none, motion: same_direction,
  period: {period}, cycles: 1, amplitude: 0.05, method: projected}}
keep: [mean_error_m]
"""
_TASKS = """
task: model
factors: {{motion: same_direction, period: 0.5, cycles: 1, amplitude: 0.02, method: projected,
  error.damping: {{low: -0.1, high: 0.1}}}}
draw: {{method: random, count: {count}}}
keep: [mean_error_m]
"""


def run(quick: bool) -> Figures:
    """Measure and print; return every figure with its unit in the key."""
    figures: Figures = {"load_average_at_start": f"{os.getloadavg()[0]:.2f}"}
    with tempfile.TemporaryDirectory() as folder:
        figures |= _speed_up(Path(folder), quick)
        figures |= _memory_of_a_worker(Path(folder), quick)
    show(figures)
    return figures


def _played(text: str, folder: Path, scheduler: str) -> float:
    """Play a study of this text; return its wall time [s]."""
    number = len(list(folder.iterdir()))
    path = folder / f"study_{number}.yaml"
    path.write_text(text)
    study = Study.read(path)
    begin = time.perf_counter()
    with contextlib.redirect_stderr(io.StringIO()):  # the figures of a benchmark stand alone
        kept = conduct(study, PlaySettings(folder / f"out_{number}", scheduler), Progress())
    wall = time.perf_counter() - begin
    failed = [row["error"] for row in kept.values() if row["error"]]
    if failed:
        raise RuntimeError(f"{len(failed)} rows failed: {failed[0]}")
    return wall


def _speed_up(folder: Path, quick: bool) -> Figures:
    """Compare one with two workers that have started, in the same runs on the twin."""
    count, period = (8, 4) if quick else (40, 10)
    walls = {}
    for workers in (1, 2):
        with local_cluster(workers) as cluster:
            address = cluster.scheduler_address
            # Each worker loads its kernels with its first run.
            _played(_RUNS.format(count=4 * workers, period=0.5), folder, address)
            walls[workers] = _played(_RUNS.format(count=count, period=period), folder, address)
    return {
        "runs_with_1_worker_s": walls[1],
        "runs_with_2_workers_s": walls[2],
        "efficiency_of_2_workers": walls[1] / walls[2] / 2,
    }


def _memory_of_a_worker(folder: Path, quick: bool) -> Figures:
    """Measure the memory of a worker after rows that hardly cost anything themselves."""
    figures: Figures = {}
    with local_cluster(1) as cluster, Client(cluster) as client:
        for count in (10, 100) if quick else (10, 100, 1000):
            _played(_TASKS.format(count=count), folder, cluster.scheduler_address)
            figures[f"memory_after_{count}_rows_mb"] = max(client.run(_memory).values())
    return figures


def _memory() -> float:
    return float(psutil.Process().memory_info().rss / 1e6)
