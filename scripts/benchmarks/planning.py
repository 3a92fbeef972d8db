"""Planning: predicted and played tip errors of every method, speed, and growth with size."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable
from itertools import product

# One core, as the figures say; set before numpy starts its threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from der_planner.limb import Limb
from der_planner.model import STEPS, ArcModel, RodModel, simulate
from der_planner.planning import (
    CONTROL_PERIOD,
    METHODS,
    Motion,
    Plan,
    Workspace,
    configuration,
    plan,
    workspace,
)
from der_planner.planning.configuration import REFERENCE_PRIOR, configure

CASES = ("asynchronous", "same_direction", "opposite_direction")
METHODS_OF = [(model, method) for model, methods in METHODS.items() for method in methods]
HARDWARE_CM = {"asynchronous": 0.64, "same_direction": 0.29, "opposite_direction": 0.84}
"""Mean tip errors that the paper reports for the rod on its hardware."""
SEEDS = (1, 2, 3, 4, 5)

Figures = dict[str, float | str]


def run(quick: bool) -> Figures:
    """Measure everything; ``quick`` takes one seed, one case on the twin and fewer sizes."""
    figures: Figures = {}
    figures |= predicted(quick)
    figures |= kinematics_and_gains()
    figures |= speed(quick)
    figures |= growth(quick)
    figures |= on_the_twin(quick)
    return figures


def without_limits(limb: Limb) -> Limb:
    """Return the limb with limits that no motion meets, to see the method alone."""
    air = dataclasses.replace(limb.pneumatics, slew_limit=1e6, pressure_limit=1e5)
    return dataclasses.replace(limb, pneumatics=air)


def predicted(quick: bool) -> Figures:
    """Tip error on the model itself: what the method leaves, with and without the limits."""
    limb = Limb.default()
    figures: Figures = {}
    print("\nPredicted tip error on the model itself, mean / max [cm] (two cycles, 45 degrees)")
    periods = (20.0, 3.0) if quick else (20.0, 6.0, 3.0)
    for label, robot in (("limits kept", limb), ("no limits", without_limits(limb))):
        print(f"  {label:34}" + "".join(f"{f'{m} {k}':>16}" for m, k in METHODS_OF))
        for period in periods:
            if label == "no limits" and period == 20.0:
                continue  # no limit is met at this period
            for case in CASES:
                row = []
                for model, method in METHODS_OF:
                    result = plan(robot, Motion.named(case, period=period), model, method)
                    key = f"{model}_{method}_{case}_{period:.0f}s_{label.replace(' ', '_')}"
                    figures[f"predicted_{key}_mean_cm"] = result.predicted_error * 100
                    figures[f"predicted_{key}_max_cm"] = result.largest_error * 100
                    row.append(
                        f"{result.predicted_error * 100:7.4f}/{result.largest_error * 100:6.3f}"
                    )
                print(f"  T = {period:4.0f} s  {case:22}" + " ".join(row))
    return figures


def kinematics_and_gains() -> Figures:
    """How far the rod's polyline is from the arcs, what its fold costs, and what the gains do."""
    limb = Limb.default()
    model = RodModel(limb)
    opposite = np.radians([45.0, -45.0])
    gap = np.linalg.norm(model.kinematics.tip(opposite) - ArcModel(limb).tip(opposite))
    # With a short connector, as calibrations find it, the rod's fold lies across this motion.
    joined = dataclasses.replace(limb, connector_length=0.002)
    kinematics = RodModel(joined).kinematics
    reference = Motion.named("asynchronous").reference(Workspace(RodModel(joined)))
    figures: Figures = {"tip_arcs_to_polyline_at_45_and_-45_degrees_mm": float(gap) * 1e3}
    print(f"\nArcs and polyline at 45/-45 degrees: tips {gap * 1e3:.1f} mm apart")
    for name, pull in (("exact", workspace.PRIOR_WEIGHT), ("smooth", REFERENCE_PRIOR)):
        angles, miss = workspace.solve(
            kinematics, reference.tip, reference.bend_angles, prior_weight=pull
        )
        twirl = np.abs(np.diff(angles, 2, axis=0)).max() / CONTROL_PERIOD**2
        figures |= {
            f"inverse_{name}_mean_miss_mm": float(miss.mean()) * 1e3,
            f"inverse_{name}_max_miss_mm": float(miss.max()) * 1e3,
            f"inverse_{name}_largest_acceleration_rad_per_s2": float(twirl),
        }
        print(
            f"  asynchronous, T = 20 s, {name:6} inverse (pull {pull:g} m/rad): miss "
            f"{miss.mean() * 1e3:.3f} mm mean, {miss.max() * 1e3:.3f} mm max, "
            f"largest acceleration {twirl:.2f} rad/s2"
        )
    motion = Motion.named("same_direction", period=6.0)
    gains = configuration.POSITION_GAIN, configuration.VELOCITY_GAIN
    configuration.POSITION_GAIN = configuration.VELOCITY_GAIN = 0.0
    without = plan(limb, motion, "der", "paper").predicted_error
    configuration.POSITION_GAIN, configuration.VELOCITY_GAIN = gains
    effect = plan(limb, motion, "der", "paper").predicted_error / without - 1
    figures["paper_gains_change_of_error_percent"] = effect * 100
    print(f"  K_p, K_d of paper change its predicted error by {effect * 100:+.3f} %")
    return figures


def _best(call: Callable[[], Plan], repetitions: int) -> tuple[float, float, Plan]:
    """Return the best wall and processor time [s] of some calls, and the last result."""
    walls, cpus = [], []
    for _ in range(repetitions):
        wall, cpu = time.perf_counter(), time.process_time()
        result = call()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return min(walls), min(cpus), result


def speed(quick: bool) -> Figures:
    """Time of planning 40 s at 20 Hz, from limb and motion to checked pressures and prediction."""
    limb, motion = Limb.default(), Motion.named("asynchronous", period=16.0)  # 2.25 periods: 36 s
    motion = dataclasses.replace(motion, period=40.0 / 2.25)
    figures: Figures = {}
    print("\nTime to plan 40 s at 20 Hz, N = 21, one core (best of several)")
    for model, method in METHODS_OF:
        wall, cpu, result = _best(lambda: plan(limb, motion, model, method), 3 if quick else 7)  # noqa: B023
        name = f"{model}_{method}_40s"
        figures[f"{name}_wall_s"], figures[f"{name}_cpu_s"] = wall, cpu
        figures[f"{name}_times_real_time"] = result.duration / cpu
        print(
            f"  {model} {method:10} {wall:7.3f} s wall  {cpu:7.3f} s processor  "
            f"{result.duration / cpu:7.0f} times real time"
        )
    return figures


def growth(quick: bool) -> Figures:
    """Time with the length of the motion, the nodes and the segments; exponents of power laws."""
    limb = Limb.default()
    figures: Figures = {}

    def many(count: int) -> Limb:
        return dataclasses.replace(limb, segments=(limb.segments[0],) * count)

    sweeps: dict[str, list[tuple[float, Limb, Motion, int]]] = {
        "duration_s": [
            (2.25 * period, limb, Motion.named("asynchronous", period=period), 21)
            for period in ((10.0, 40.0) if quick else (10.0, 20.0, 40.0, 80.0))
        ],
        "nodes": [
            (n, limb, Motion.named("asynchronous", period=16.0), n)
            for n in ((11, 41) if quick else (11, 21, 41, 81))
        ],
        "segments": [
            (m, many(m), Motion.named("same_direction", 0.5, 16.0), 10 * m + 1)
            for m in ((1, 3) if quick else (1, 2, 3, 4))
        ],
    }
    print("\nGrowth of the processor time [s]; segments: ten nodes each")
    for method in ("projected", "optimal"):
        for what, points in sweeps.items():
            sizes, times = [], []
            for size, robot, motion, nodes in points:
                _, cpu, _ = _best(lambda: plan(robot, motion, "der", method, nodes=nodes), 2)  # noqa: B023
                figures[f"der_{method}_{what}_{size:g}_cpu_s"] = cpu
                sizes.append(size)
                times.append(cpu)
            slope = float(np.polyfit(np.log(sizes), np.log(times), 1)[0])
            figures[f"der_{method}_growth_exponent_with_{what.removesuffix('_s')}"] = slope
            listed = ", ".join(f"{s:g}: {t:.3f}" for s, t in zip(sizes, times, strict=True))
            print(f"  {method:10} {what:11} {listed}   exponent {slope:.2f}")
    return figures


def _rod_under(result: Plan, chambers: np.ndarray) -> np.ndarray:
    """Return the tip (K, 2) of the identified rod under the pressures that the chambers really had.

    Its distance from the played tip is the identification's part of the error: no open-loop plan on
    this model can do better but by luck.
    """
    motion = configure(RodModel(result.limb), result.reference)
    response = simulate(
        motion.model,
        result.time,
        pressures=chambers,
        bend=motion.bend_at,
        initial=motion.initial,
        steps=STEPS,
    )
    return response.tip


def on_the_twin(quick: bool) -> Figures:
    """Errors on the twin, each seed calibrated by its own run: mean and std over seeds, max."""
    from der_planner.identification import calibrate_twin  # noqa: PLC0415 - heavy, last part
    from der_planner.twin.offline import play  # noqa: PLC0415

    seeds, cases = (SEEDS[:1], CASES[1:2]) if quick else (SEEDS, CASES)
    periods = (20.0,) if quick else (20.0, 6.0)
    errors: dict[tuple[float, str, str, str], list[np.ndarray]] = {}
    print("\nCalibrating each seed's twin, then playing every plan on it", flush=True)
    for seed in seeds:
        begin = time.perf_counter()
        limb, _ = calibrate_twin(seed, Limb.default())
        print(f"  seed {seed}: calibrated in {time.perf_counter() - begin:.0f} s", flush=True)
        for period, case, (model, method) in product(periods, cases, METHODS_OF):
            result = plan(limb, Motion.named(case, period=period), model, method)
            played = play(result.time, result.differential_pressure, seed=seed, run=1)
            difference = played.tip - result.tip_reference
            errors.setdefault((period, case, model, method), []).append(difference)
            if method == "optimal":
                known = played.tip - _rod_under(result, played.measured_differential)
                errors.setdefault((period, case, "rod", "as played"), []).append(known)
    figures: Figures = {"twin_seeds": float(len(seeds))}
    print(f"\nTip error on the twin [cm], {len(seeds)} seeds: total ± std / x / y, max")
    for (period, case, model, method), runs in errors.items():
        means = np.array([np.linalg.norm(d, axis=1).mean() for d in runs]) * 100
        x, y = (np.array([np.abs(d[:, i]).mean() for d in runs]).mean() * 100 for i in (0, 1))
        largest = max(np.linalg.norm(d, axis=1).max() for d in runs) * 100
        key = f"twin_{model}_{method}_{case}_{period:.0f}s".replace(" ", "_")
        figures[f"{key}_mean_cm"], figures[f"{key}_std_cm"] = means.mean(), means.std()
        figures[f"{key}_x_cm"], figures[f"{key}_y_cm"] = float(x), float(y)
        figures[f"{key}_max_cm"] = largest
        paper = f"   (rod on the paper's hardware {HARDWARE_CM[case]:.2f})" if period == 20 else ""
        print(
            f"  T = {period:4.0f} s  {case:20} {model} {method:10} {means.mean():.3f} ± "
            f"{means.std():.3f} / {x:.3f} / {y:.3f}, max {largest:.2f}{paper}"
        )
    return figures
