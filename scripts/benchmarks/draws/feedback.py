"""Does feedback do harm? Drawn limbs, each with a file of small errors and with none of its own.

A limb differs from the default one by the spreads from day to day (`benchmarks.draws.limb`); its
outlets are slow and it rubs and creeps. It plays one of the three joint motions at 20 s and at 6 s,
planned with a file as a calibration would leave it (`calibrated`) and with the default limb's file
(`default`), in open loop and with feedback. The camera's noise (half to twice the lock-step's), its
latency and the share of its pictures that are lost are drawn, too. Feedback counts as worse where
its true mean tip error exceeds that of open loop by more than the camera's noise.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.draws.limb import DrawnLimb, drawn, nearly, with_slow_air
from der_planner.control.feedback import Feedback
from der_planner.control.lockstep import Sensors, play
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, PlanningError, plan
from der_planner.planning.motions import JOINT_MOTIONS

Array = NDArray[np.float64]
Figures = dict[str, float | list[float]]

LIMBS, QUICK_LIMBS = 100, 4
PERIODS = (20.0, 6.0)
MOST_LOST = 0.1
"""Largest share of the pictures that are lost."""


@dataclass(frozen=True)
class Pair:
    """One motion of one limb in open loop and with feedback.

    Attributes:
        alone, corrected: true mean tip error [m].
        noise: of the camera [m].
        warned: reasons for which feedback was taken back.
    """

    alone: float
    corrected: float
    noise: float
    warned: tuple[str, ...]

    @property
    def worse(self) -> bool:
        """Tell if feedback did harm."""
        return self.corrected > self.alone + self.noise

    @property
    def ratio(self) -> float:
        """Error with feedback over that without."""
        return self.corrected / self.alone


def _sensors(generator: np.random.Generator) -> Sensors:
    usual, noise = Sensors(), generator.uniform(0.5, 2.0)
    lost = generator.uniform(size=10_000) < generator.uniform(0.0, MOST_LOST)
    return Sensors(
        latency=generator.uniform(0.04, 0.1),
        bend_noise=usual.bend_noise * noise,
        tip_noise=usual.tip_noise * noise,
        seed=int(generator.integers(1000)),
        seen=lambda instant: not lost[round(instant * usual.frame_rate) % len(lost)],
    )


def draw(number: int) -> tuple[Limb, dict[str, dict[float, Plan]], Sensors]:
    """Return a true limb, the plans for it by file and period, and its sensors.

    A limb that cannot reach its motion, by its file, is drawn anew.
    """
    case = JOINT_MOTIONS[number % len(JOINT_MOTIONS)]
    generator = np.random.default_rng([78, number])
    while True:
        true = with_slow_air(drawn(Limb.default(), generator), generator)
        files = {"calibrated": nearly(true, generator), "default": Limb.default()}
        try:
            plans = {
                name: {
                    period: plan(file, Motion.named(case, period=period, cycles=1))
                    for period in PERIODS
                }
                for name, file in files.items()
            }
        except PlanningError:
            continue
        return true, plans, _sensors(generator)


def _pair(planned: Plan, true: Limb, sensors: Sensors) -> Pair:
    feedback = Feedback(planned)
    alone = play(planned, DrawnLimb(true)).error.mean()
    corrected = play(planned, DrawnLimb(true), feedback, sensors).error.mean()
    names = tuple(warned.name for warned in feedback.warnings)
    return Pair(float(alone), float(corrected), sensors.tip_noise, names)


def run(quick: bool = False) -> Figures:
    """Print the errors of each limb, and how often feedback did harm; return the figures."""
    count = QUICK_LIMBS if quick else LIMBS
    found: dict[str, list[Pair]] = {}
    print("true mean tip error in cm, open loop > feedback")
    for number in range(count):
        begin = time.process_time()
        true, plans, sensors = draw(number)
        said = []
        for name, by_period in plans.items():
            for period, planned in by_period.items():
                pair = _pair(planned, true, sensors)
                found.setdefault(f"{name}_{period:.0f}s", []).append(pair)
                notes = " WORSE" * pair.worse + "".join(f" ({name})" for name in pair.warned)
                said.append(f"{100 * pair.alone:6.3f} > {100 * pair.corrected:5.3f}{notes}")
        spent = time.process_time() - begin
        case = JOINT_MOTIONS[number % len(JOINT_MOTIONS)]
        print(f"{number:3d} {case:<18} {' | '.join(said)} (CPU {spent:.0f} s)", flush=True)
    figures: Figures = {"limbs": count}
    print("over the limbs: worse; warned; error over that of open loop: median, largest")
    for name, pairs in found.items():
        ratios = [pair.ratio for pair in pairs]
        warned = sorted({reason for pair in pairs for reason in pair.warned})
        told = {
            "worse": sum(pair.worse for pair in pairs),
            "warned": sum(bool(pair.warned) for pair in pairs),
            "median_ratio": float(np.median(ratios)),
            "largest_ratio": max(ratios),
            "alone_m": float(np.mean([pair.alone for pair in pairs])),
            "corrected_m": float(np.mean([pair.corrected for pair in pairs])),
        }
        print(
            f"  {name:<16} {told['worse']:3d} of {count}; {told['warned']:3d} "
            f"({', '.join(warned) or 'none'}); {told['median_ratio']:.2f}, "
            f"{told['largest_ratio']:.2f}; mean {100 * told['alone_m']:.3f} > "
            f"{100 * told['corrected_m']:.3f} cm"
        )
        figures |= {f"{name}_{key}": value for key, value in told.items()}
    return figures
