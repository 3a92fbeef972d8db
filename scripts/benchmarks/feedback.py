"""What feedback takes away of the tip error on a twin, what it costs, and how soon the board knows.

On the whole graph: what estimate and replan took for each setpoint that was revised, and the time
from the instant of a picture to the first command at the board that knows of it. Then, in one
process, a calibrated twin plays every motion in open loop, with feedback, as learned from two runs,
and as learned with feedback; and the first motion with the default limb's file, as if nobody had
calibrated it. Then something happens to the limb (`feedback_events`). The cost is that of
`measure` and `command` together, as the planner calls them for one setpoint.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from benchmarks import feedback_events
from der_planner.bags.reader import BagReader
from der_planner.bags.record import ESTIMATE_TYPE
from der_planner.control import Learner
from der_planner.control.feedback import Feedback
from der_planner.control.lockstep import Sensors, play
from der_planner.identification.offline import calibrate_twin
from der_planner.limb import Limb
from der_planner.planning import Motion, Plan, plan
from der_planner.planning.motions import JOINT_MOTIONS
from der_planner.twin.offline import OfflineTwin

Array = NDArray[np.float64]

SEEDS = (101,)
PERIODS = (20.0, 6.0)
LEARNED_FROM = 2
"""Runs in open loop that a plan is learned from."""
WAYS = ("open_loop", "feedback", "learned", "learned_feedback")
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


def _on_the_graph() -> dict[str, float]:
    """Play a motion of 20 s on the whole graph; return its figures."""
    script = Path(__file__).resolve().parents[1] / "run_experiment.py"
    options = (
        "--models der --motions asynchronous --cycles 1 --feedback --no-calibration --seed 101"
    )
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(script), *options.split(), "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"the graph did not run: {done.stderr.strip()[-500:]}")
        results = json.loads((Path(folder) / "results.json").read_text())
        runs = {entry["method"]: entry for entry in results["runs"]}
        corrected, alone = runs["optimal + feedback"], runs["optimal"]
        bag = Path(corrected["bag"])
        took = _solve_times(bag if bag.is_absolute() else Path(folder) / bag)
        checks = corrected["checks"]
    told = corrected["extra"]["feedback"]
    return {
        "graph_open_loop_m": alone["mean_error_m"],
        "graph_feedback_m": corrected["mean_error_m"],
        "graph_replan_median_s": float(np.median(took)),
        "graph_replan_p99_s": float(np.quantile(took, 0.99)),
        "graph_picture_to_board_median_s": told["latency_median_s"],
        "graph_picture_to_board_p99_s": told["latency_p99_s"],
        "graph_setpoint_late_p99_s": checks["board_lateness_p99_s"],
    }


def _solve_times(bag: Path) -> np.ndarray:
    """Return what estimate and replan took for each estimate of a bag [s]."""
    with BagReader(bag) as reader:
        topics = [name for name, t in reader.topics.items() if t.type_name == ESTIMATE_TYPE]
        return np.array([message.solve_time for _, _, message in reader.messages(topics)])


def _learned(planned: Plan, seed: int) -> Plan:
    """Return the plan after runs of it, as a camera would have seen them."""
    learner, noise = Learner(planned), Sensors().tip_noise
    for run in range(LEARNED_FROM):
        played = play(planned, _twin(seed))
        generator = np.random.default_rng([seed, run])
        tip = played.tip + noise * generator.standard_normal(played.tip.shape)
        chambers = played.time, played.differential_pressure
        learner.add(planned.time, tip, chambers=chambers)
        planned = learner.next()
        if learner.stopped:
            break
    return planned


def _errors(seed: int, limb: Limb, case: str, period: float, ways: int) -> tuple[Array, Array]:
    """Return mean tip errors [m] in the first ``ways`` of `WAYS`, and what commands took [s]."""
    planned = plan(limb, Motion.named(case, period=period, cycles=1))
    errors, took = [], []
    for again in range(ways // 2):
        each = _learned(planned, seed) if again else planned
        feedback = _Timed(each)
        errors.append(play(each, _twin(seed)).error.mean())
        errors.append(play(each, _twin(seed), feedback).error.mean())
        took += feedback.took
    return np.array(errors), np.array(took)


def run(quick: bool = False) -> dict[str, float]:
    """Print mean tip errors with and without feedback, and the cost of a command; return all."""
    figures = _on_the_graph()
    for name, value in figures.items():
        unit, scale = ("ms", 1e3) if name.endswith("_s") else ("cm", 1e2)
        print(f"  {name.rpartition('_')[0]:<42} {value * scale:8.3f} {unit}", flush=True)
    seeds, periods = (SEEDS[:1], PERIODS[:1]) if quick else (SEEDS, PERIODS)
    cases = JOINT_MOTIONS[:1] if quick else JOINT_MOTIONS
    limbs = {seed: calibrate_twin(seed, Limb.default())[0] for seed in seeds}
    table = [("calibrated", limbs, case, period, 4) for period in periods for case in cases]
    table.append(("default", dict.fromkeys(seeds, Limb.default()), cases[0], periods[0], 2))
    print(f"mean tip error in cm over the twins: {', '.join(WAYS)}; most of any twin's")
    took = []
    for name, by_seed, case, period, ways in table:
        rows = [_errors(seed, limb, case, period, ways) for seed, limb in by_seed.items()]
        errors = np.array([row[0] for row in rows])
        took += [row[1] for row in rows]
        key = f"{name}_{case}_{period:.0f}s"
        for way, mean in zip(WAYS, errors.mean(axis=0), strict=False):
            figures[f"{key}_{way}_m"] = float(mean)
        told = [" ".join(f"{100 * x:7.3f}" for x in row) for row in (errors.mean(0), errors.max(0))]
        print(f"  {key:<38} {told[0]}  ; {told[1]}", flush=True)
    print(f"events on the twin of seed {seeds[0]}")
    figures |= feedback_events.measure(limbs[seeds[0]], seeds[0])
    median, late = np.quantile(np.concatenate(took), [0.5, 0.99])
    figures["command_median_s"], figures["command_p99_s"] = float(median), float(late)
    print(f"estimate and replan: median {median * 1e3:.1f} ms, p99 {late * 1e3:.1f} ms")
    return figures
