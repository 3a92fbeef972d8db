"""What a study costs beside its runs: speed-up, cost of a task, memory of a worker; many rods."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
from distributed import Client, LocalCluster

from benchmarks.rod import cantilever, run_elastica
from der_planner.experiment.progress import Progress
from der_planner.rod.many import cores
from der_planner.rod.many import simulate_many as simulate_rods
from der_planner.studies.conduct import Settings, conduct
from der_planner.studies.study import Study
from der_planner.studies.tasks import TASKS

Figures = dict[str, float | str]

DISMECH_GPU = 137_000.0
"""Rod-steps a second of dismech-newton on an RTX 2070S, by its own document."""
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


class _Silent(Progress):
    """Says nothing: the figures of a benchmark stand alone."""

    def say(self, text: str) -> None:
        """Say nothing."""

    def bar(self, done: float, total: float, text: str, unit: str = "s") -> None:
        """Show nothing."""


def run(quick: bool) -> Figures:
    """Measure and print; return every figure with its unit in the key."""
    figures: Figures = {"load_average_at_start": f"{os.getloadavg()[0]:.2f}"}
    figures |= _rods(quick)
    figures |= _speed_up(quick)
    return figures | _tasks(quick)


def _best(work: Callable[[], object], repetitions: int) -> tuple[float, float]:
    """Return the least wall time, and the least processor time of all threads [s]."""
    walls, processors = [], []
    for _ in range(repetitions):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        processors.append(time.process_time() - processor)
    return min(walls), min(processors)


def _rods(quick: bool) -> Figures:
    """Planar cantilevers with 21 nodes, released, by backward Euler of 5 ms, beside one alone."""
    rod = cantilever(21, plane="xz", clamp="inside")
    start, steps = rod.straight_state(), 200
    runs, repetitions = (200, 3) if quick else (2000, 5)
    still = np.zeros((runs, steps, 0))
    method = "backward_euler"
    simulate_rods(rod, start, still[:2], 5e-3, method=method)
    alone, _ = _best(lambda: rod.simulate(start, still[0], 5e-3, method=method), 20 * repetitions)
    wall, processor = _best(
        lambda: simulate_rods(rod, start, still, 5e-3, method=method), repetitions
    )
    run_elastica(20, 1e-5, 1e-4)  # compiles
    elastica = run_elastica(20, 1e-5, 0.02)
    count = runs * steps
    figures: Figures = {
        "cores": cores(),
        "planar_n21_single_rod_steps_per_s": steps / alone,
        "planar_n21_many_rod_steps_per_s": count / wall,
        "planar_n21_many_rod_steps_per_s_and_core": count / wall / cores(),
        "planar_n21_many_rod_steps_per_processor_s": count / processor,
        "planar_n21_share_of_cores_times_single": count / wall * alone / steps / cores(),
        "pyelastica_n21_rod_steps_per_s": elastica.steps / elastica.seconds,
        "reported_dismech_newton_rtx_2070s_rod_steps_per_s": DISMECH_GPU,
    }
    print(f"{runs} planar rods of 21 nodes, {steps} steps (backward Euler, 5 ms), {cores()} cores")
    for name, value in list(figures.items())[1:]:
        print(
            f"  {name:52s} {value:12,.3g}" if float(value) < 10 else f"  {name:52s} {value:12,.0f}"
        )
    return figures


def _played(text: str, folder: Path, **settings: object) -> tuple[float, list[float]]:
    """Play a study of this text; return its wall time and what each of its tasks took [s]."""
    number = len(list(folder.iterdir()))
    path = folder / f"study_{number}.yaml"
    path.write_text(text)
    study, out = Study.read(path), folder / f"out_{number}"
    begin = time.perf_counter()
    kept = conduct(study, Settings(out, **settings), _Silent())  # type: ignore[arg-type]
    wall = time.perf_counter() - begin
    failed = [row["error"] for row in kept.values() if row["error"]]
    if failed:
        raise RuntimeError(f"{len(failed)} rows failed: {failed[0]}")
    lines = (out / "times.csv").read_text().splitlines()
    return wall, [float(line.rsplit(",", 1)[1]) for line in lines]


def _cluster(workers: int) -> LocalCluster:
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        memory_limit=0,
    )


def _speed_up(quick: bool) -> Figures:
    """Compare one with two workers that have started, in the same runs on the twin."""
    count, period = (8, 4) if quick else (40, 10)
    walls, begin = {}, os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        for workers in (1, 2):
            with _cluster(workers) as cluster:
                address = cluster.scheduler_address
                # Each worker loads its kernels with its first run.
                few = _RUNS.format(count=4 * workers, period=0.5)
                _played(few, Path(name), scheduler=address)
                walls[workers], _ = _played(
                    _RUNS.format(count=count, period=period), Path(name), scheduler=address
                )
    speed_up = walls[1] / walls[2]
    print(
        f"{count} runs on the twin: {walls[1]:.1f} s with one worker, {walls[2]:.1f} s with two: "
        f"efficiency {speed_up / 2:.2f} (load average before: {begin:.2f})"
    )
    return {
        "runs_with_1_worker_s": walls[1],
        "runs_with_2_workers_s": walls[2],
        "efficiency_of_2_workers": speed_up / 2,
        "speed_up_load_average": f"{begin:.2f}",
    }


def _tasks(quick: bool) -> Figures:
    """Measure what a task costs beside its own work, and the memory of the worker that did it."""
    figures: Figures = {}
    rows = TASKS["model"].batch
    print("tasks: cost of each beside its work [ms], memory of the worker afterwards [MB]")
    with tempfile.TemporaryDirectory() as name, _cluster(1) as cluster, Client(cluster) as client:
        address = cluster.scheduler_address
        _played(_TASKS.format(count=2 * rows), Path(name), scheduler=address)
        for count in (10, 100) if quick else (10, 100, 1000):
            wall, times = _played(_TASKS.format(count=count * rows), Path(name), scheduler=address)
            figures[f"cost_of_each_of_{count}_tasks_ms"] = (wall - sum(times)) / count * 1e3
            figures[f"memory_after_{count}_tasks_mb"] = max(client.run(_memory).values())
            print(
                f"  {count:5d} {figures[f'cost_of_each_of_{count}_tasks_ms']:8.2f} "
                f"{figures[f'memory_after_{count}_tasks_mb']:8.0f}",
                flush=True,
            )
    return figures


def _memory() -> float:
    return float(psutil.Process().memory_info().rss / 1e6)
