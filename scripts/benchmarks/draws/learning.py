"""Does learning diverge? Drawn limbs of other numbers than their plan's, eight runs each.

Each limb differs from the default one, whose plan it is given uncalibrated: gain and rest angle by
the spreads from day to day (35 % and 6°, normal), stiffness, friction, air, dead time and the
chambers' gains within ranges, and its rest wanders from run to run by up to 1 mm at the tip. A run
counts as diverged if its true mean error exceeds that of the first run by more than a tenth and its
own wander.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from benchmarks.draws.limb import drawn
from der_planner.control import Learner
from der_planner.limb import Limb
from der_planner.model import simulate
from der_planner.planning import Motion, Plan, plan
from der_planner.planning.motions import JOINT_MOTIONS

Array = NDArray[np.float64]
Figures = dict[str, float | list[float]]

LIMBS, QUICK_LIMBS = 100, 12
RUNS = 8
PERIODS = (6.0, 10.0)
LARGEST_WANDER = 1e-3
"""Of the tip, from run to run [m]."""
CAMERA_NOISE = 1e-4
"""Standard deviation of the tip [m]."""
_WORSE = 1.1


def _curve(first: Plan, true: Limb, generator: np.random.Generator) -> tuple[Array, float, Learner]:
    """Return the true mean error of each run [m], the limb's wander [m], and the learner."""
    learner, planned, errors = Learner(first), first, []
    deviation = generator.uniform(0.0, LARGEST_WANDER)
    for _ in range(RUNS):
        tip = simulate(true, planned.time, commands=planned.differential_pressure).tip[:-1]
        errors.append(float(np.linalg.norm(tip - planned.tip_reference, axis=1).mean()))
        wander = deviation * generator.standard_normal(2)
        grows = np.minimum(1.0, 0.3 + planned.time / planned.time[-1])
        noise = CAMERA_NOISE * generator.standard_normal(tip.shape)
        learner.add(planned.time, tip + grows[:, None] * wander + noise)
        if learner.stopped:
            break
        planned = learner.next()
    return np.array(errors), deviation, learner


def run(quick: bool = False) -> Figures:
    """Print the curve of each limb and return how many diverged."""
    plans: dict[tuple[str, float], Plan] = {}
    diverged, refused, shares, worst = 0, 0, [], []
    count = QUICK_LIMBS if quick else LIMBS
    print("true mean tip error in cm of each run until learning stops")
    for number in range(count):
        generator = np.random.default_rng([77, number])
        case, period = JOINT_MOTIONS[number % 3], PERIODS[number // 3 % 2]
        if (case, period) not in plans:
            motion = Motion.named(case, period=period, cycles=1)
            plans[case, period] = plan(Limb.default(), motion, method="optimal")
        begin = time.process_time()
        true = drawn(Limb.default(), generator)
        errors, wander, learner = _curve(plans[case, period], true, generator)
        worse = bool(np.any(errors[1:] > _WORSE * errors[0] + wander))
        diverged += worse
        refused += not any(entry.accepted for entry in learner.history)
        shares.append(float(errors[-1] / errors[0]))
        worst.append(float(errors[1:].max() / errors[0]) if len(errors) > 1 else 1.0)
        said = " ".join(f"{100 * error:.3f}" for error in errors)
        notes = " DIVERGED" if worse else ""
        notes += "".join(
            f"; run {entry.number} {entry.reason[:60]}"
            for entry in learner.history
            if not entry.accepted
        )
        spent = time.process_time() - begin
        print(
            f"{number:3d} {case} {period:.0f} s: {said} (CPU {spent:.1f} s){notes}"
            f" | {diverged} of {number + 1} diverged",
            flush=True,
        )
    print(
        f"{diverged} of {count} limbs diverged, {refused} refused in all runs; the last run leaves "
        f"{np.median(shares):.1%} of the first's error (median), {max(shares):.0%} at the most"
    )
    return {
        "limbs": count,
        "diverged": diverged,
        "refused": refused,
        "median_last_over_first": float(np.median(shares)),
        "largest_last_over_first": max(shares),
        "largest_run_over_first": max(worst),
    }
