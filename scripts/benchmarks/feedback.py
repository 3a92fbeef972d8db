"""What feedback takes away of the tip error on twins, and what a command of it costs.

Twins play with the default limb's file, as if nobody had calibrated them, and with their own. The
cost is that of `measure` and `command` together, as the planner calls them for one setpoint.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import ArrayLike

from der_planner.control.feedback import Feedback
from der_planner.control.lockstep import play
from der_planner.identification.offline import calibrate_twin
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, plan
from der_planner.planning.motions import JOINT_MOTIONS
from der_planner.twin.offline import OfflineTwin

SEEDS = (101, 102, 103)
PERIODS = (20.0, 6.0)
_REST = 1.0
"""A twin is vented for so long before its plan is played [s]."""


class _Timed(Feedback):
    """Feedback that keeps what each command and the pictures before it took."""

    def __init__(self, plan: Plan) -> None:
        super().__init__(plan)
        self.took: list[float] = []
        self._pictures = 0.0

    def measure(
        self,
        time_: float,
        bend_angle: ArrayLike,
        tip: ArrayLike,
        covariance: ArrayLike | None = None,
    ) -> None:
        begin = time.perf_counter()
        super().measure(time_, bend_angle, tip, covariance)
        self._pictures += time.perf_counter() - begin

    def command(self, time_: float) -> np.ndarray:
        begin = time.perf_counter()
        command = super().command(time_)
        self.took.append(time.perf_counter() - begin + self._pictures)
        self._pictures = 0.0
        return command


def _twin(seed: int) -> OfflineTwin:
    twin = OfflineTwin(seed)
    twin.rest(_REST)
    return twin


def run(quick: bool = False) -> dict[str, float]:
    """Print mean tip errors with and without feedback, and the cost of a command; return all."""
    figures: dict[str, float] = {}
    took: list[float] = []
    seeds = SEEDS[:1] if quick else SEEDS
    limbs = {"calibrated": {seed: calibrate_twin(seed, Limb.default())[0] for seed in seeds}}
    limbs["default"] = dict.fromkeys(seeds, Limb.default())
    print("mean tip error in cm over the twins: open loop, feedback")
    for name, by_seed in limbs.items():
        for period in PERIODS[:1] if quick else PERIODS:
            for case in JOINT_MOTIONS[:1] if quick else JOINT_MOTIONS:
                errors = []
                for seed, limb in by_seed.items():
                    planned = plan(limb, Motion.named(case, period=period, cycles=1))
                    feedback = _Timed(planned)
                    alone = play(planned, _twin(seed)).error.mean()
                    errors.append((alone, play(planned, _twin(seed), feedback).error.mean()))
                    took += feedback.took
                alone, corrected = np.mean(errors, axis=0)
                key = f"{name}_{case}_{period:.0f}s"
                figures[f"{key}_open_loop_m"] = float(alone)
                figures[f"{key}_feedback_m"] = float(corrected)
                print(f"  {key:<42} {alone * 100:8.3f} {corrected * 100:8.3f}", flush=True)
    median, late = np.quantile(took, [0.5, 0.99])
    figures["command_median_s"], figures["command_p99_s"] = float(median), float(late)
    print(f"estimate and replan: median {median * 1e3:.1f} ms, p99 {late * 1e3:.1f} ms")
    return figures
