"""Planning: predicted tip errors of every method, and the time that a plan takes."""

from __future__ import annotations

import dataclasses
import os
import time

# One core, as the figures say; set before numpy starts its threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks import show
from der_planner.limb import Limb
from der_planner.planning import METHODS, Motion, plan

CASES = ("asynchronous", "same_direction", "opposite_direction")
METHODS_OF = [(model, method) for model, methods in METHODS.items() for method in methods]


def run(quick: bool) -> dict[str, float | str]:
    """Measure and print; return every figure with its unit in the key."""
    return predicted((20.0, 3.0) if quick else (20.0, 6.0, 3.0)) | speed(3 if quick else 7)


def predicted(periods: tuple[float, ...]) -> dict[str, float | str]:
    """Tip error on the model itself: what the method leaves, with and without the limits."""
    limb, figures = Limb.default(), {}
    air = dataclasses.replace(limb.pneumatics, slew_limit=1e6, pressure_limit=1e5)
    without_limits = dataclasses.replace(limb, pneumatics=air)
    print("\nPredicted tip error on the model itself, mean / max [cm] (two cycles, 45 degrees)")
    for label, robot in (("limits kept", limb), ("no limits", without_limits)):
        print(f"  {label:34}" + "".join(f"{f'{m} {k}':>16}" for m, k in METHODS_OF))
        for period in periods:
            if label == "no limits" and period == 20.0:
                continue  # no limit is met at this period
            for case in CASES:
                row = []
                for model, method in METHODS_OF:
                    result = plan(robot, Motion.named(case, period=period), model, method)
                    mean, largest = result.predicted_error * 100, result.largest_error * 100
                    key = f"{model}_{method}_{case}_{period:.0f}s_{label.replace(' ', '_')}"
                    figures[f"predicted_{key}_mean_cm"] = mean
                    figures[f"predicted_{key}_max_cm"] = largest
                    row.append(f"{mean:7.4f}/{largest:6.3f}")
                print(f"  T = {period:4.0f} s  {case:22}" + " ".join(row))
    return figures


def speed(repetitions: int) -> dict[str, float | str]:
    """Time of planning 40 s at 20 Hz, from limb and motion to checked pressures and prediction."""
    # With its ramp a motion of two cycles lasts 2.25 periods.
    limb, motion = Limb.default(), Motion.named("asynchronous", period=40.0 / 2.25)
    figures: dict[str, float | str] = {}
    print("\nTime to plan 40 s at 20 Hz, N = 21, one core (best of several)")
    for model, method in METHODS_OF:
        taken = []
        for _ in range(repetitions):
            begin = time.process_time()
            plan(limb, motion, model, method)
            taken.append(time.process_time() - begin)
        figures[f"{model}_{method}_40s_cpu_s"] = min(taken)
    show(figures)
    return figures
