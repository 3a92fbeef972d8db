"""How fast learning lowers the tip error of fresh twins, beside what does not repeat and an oracle.

Two kinds of runs: ``wandering``, each with rest angles that wander on their own, as on the graph,
and ``same``, all with the same wander, which shows what the learner itself can do. The tip is
filmed with the noise of a calibration. Beside the curves:

- floor: mean distance between a run of the first plan and the mean of five of its runs;
- oracle: distance of the tip from that of the identified rod under the chamber pressures of the
  run, with its true rest angles: what no knowledge of air and rest would take away.

Twin after twin, so that what was printed before an end is whole for the twins that it names. Five
twins take a quarter of an hour of CPU time.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from der_planner.control import Learner
from der_planner.identification.offline import TIP_NOISE, calibrate_twin
from der_planner.limb import Limb
from der_planner.model import simulate
from der_planner.planning import Motion, Plan, plan
from der_planner.planning.motions import JOINT_MOTIONS
from der_planner.twin.offline import play

Array = NDArray[np.float64]
Figures = dict[str, float | list[float]]

FRESH_SEEDS = (101, 102, 103, 104, 105)
PERIODS = (20.0, 6.0)
RUNS = 4
FLOOR_RUNS = 4


def _error(planned: Plan, tip: Array) -> float:
    return float(np.linalg.norm(tip - planned.tip_reference, axis=1).mean())


def _curve(first: Plan, seed: int, wandering: bool, slowest: list[float]) -> list[float]:
    """Return the mean error [m] of each run."""
    learner, planned, errors = Learner(first), first, []
    generator = np.random.default_rng([seed, 16])
    for number in range(RUNS):
        played = play(
            planned.time,
            planned.differential_pressure,
            seed,
            run=10 + number if wandering else 0,
        )
        errors.append(_error(planned, played.tip))
        begin = time.process_time()
        noise = TIP_NOISE * generator.standard_normal(played.tip.shape)
        learner.add(played.time, played.tip + noise)
        planned = learner.next()
        slowest.append(time.process_time() - begin)
    return errors


def _floor_and_oracle(first: Plan, limb: Limb, seed: int) -> tuple[float, float]:
    runs = [
        play(first.time, first.differential_pressure, seed, run=10 + number)
        for number in range(FLOOR_RUNS)
    ]
    tips = np.array([run.tip for run in runs])
    spread = np.linalg.norm(tips - tips.mean(axis=0), axis=2).mean()
    floor = float(spread) * float(np.sqrt(FLOOR_RUNS / (FLOOR_RUNS - 1)))
    seen = runs[0]
    told = replace(
        limb,
        segments=tuple(
            replace(segment, rest_curvature=float(angle) / segment.length)
            for segment, angle in zip(limb.segments, seen.bend_angles[0], strict=True)
        ),
    )
    model = simulate(told, seen.time, pressures=seen.measured_differential)
    return floor, float(np.linalg.norm(model.tip - seen.tip, axis=1).mean())


def run(quick: bool = False) -> Figures:
    """Print the curves of every twin, their means over the twins, and return all."""
    seeds = FRESH_SEEDS[:1] if quick else FRESH_SEEDS
    slowest: list[float] = []
    tables: dict[tuple[float, str], list[list[float]]] = {
        (period, case): [] for period in PERIODS for case in JOINT_MOTIONS
    }
    print("mean tip error in cm of the first plan and after 1, 2 ... runs; floor; oracle")
    for seed in seeds:
        limb = calibrate_twin(seed, Limb.default())[0]
        for (period, case), table in tables.items():
            motion = Motion.named(case, period=period, cycles=1)
            first = plan(limb, motion, method="optimal")
            same = _curve(first, seed, False, slowest)
            wandering = _curve(first, seed, True, slowest)
            table.append([*same, *wandering, *_floor_and_oracle(first, limb, seed)])
            _say(f"{period:.0f} s {case}, seed {seed}", table[-1])
    figures: Figures = {}
    for (period, case), table in tables.items():
        mean = np.mean(table, axis=0)
        _say(f"{period:.0f} s {case}, mean", list(mean))
        name = f"{case}_{period:.0f}s"
        figures[f"{name}_same_m"] = mean[:RUNS].tolist()
        figures[f"{name}_wandering_m"] = mean[RUNS : 2 * RUNS].tolist()
        figures[f"{name}_floor_m"], figures[f"{name}_oracle_m"] = map(float, mean[-2:])
    figures["slowest_step_cpu_s"] = max(slowest)
    figures["median_step_cpu_s"] = float(np.median(slowest))
    print(f"a step: median {np.median(slowest):.2f} s of CPU, slowest {max(slowest):.2f} s")
    return figures


def _say(name: str, row: list[float]) -> None:
    def curve(values: list[float]) -> str:
        return " ".join(f"{value * 100:.3f}" for value in values)

    print(
        f"{name:<34} same {curve(row[:RUNS])} | wandering {curve(row[RUNS : 2 * RUNS])} | "
        f"floor {row[-2] * 100:.3f} oracle {row[-1] * 100:.3f}",
        flush=True,
    )
