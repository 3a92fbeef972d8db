"""What feedback costs, and what events do to a twin.

On the whole graph: what estimate and replan took for each setpoint that was revised. Then, in one
process, a calibrated twin plays one motion in open loop and with feedback while something happens
to it: a gain 20 % lower from the start, 20 g put on the tip at mid-run, and a push of 0.3 N on the
tip for 0.2 s. Errors without events: ``python3 scripts/study.py feedback``.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import show
from der_planner.bags.reader import BagReader
from der_planner.bags.record import ESTIMATE_TYPE
from der_planner.control.feedback import Feedback
from der_planner.control.lockstep import Played, play
from der_planner.identification.excitation import calibrate_twin
from der_planner.limb import Limb
from der_planner.planning import Motion, plan
from der_planner.twin import Push
from der_planner.twin.offline import OfflineTwin

SEED = 101
PERIOD = 20.0
CASE = "asynchronous"
INSTANT = 8.0
"""The payload is put on and the push begins at this time of the plan [s]."""
TIP = 0.244
"""Arc length of the twin's tip [m]."""
PUSHED = 0.2
"""The push lasts this long [s]."""
DIED = 0.2
"""A swing that has fallen to this share of its largest size has died."""
REST = 1.0
"""The twin is vented for this long before its plan is played [s]."""


def _on_the_graph() -> dict[str, float]:
    """Play a motion of 20 s on the whole graph; return what its commands took."""
    script = Path(__file__).resolve().parents[1] / "run_experiment.py"
    options = f"--models der --motions {CASE} --cycles 1 --feedback --no-calibration --seed {SEED}"
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(script), *options.split(), "--out", folder]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"the graph did not run: {done.stderr.strip()[-500:]}")
        results = json.loads((Path(folder) / "results.json").read_text())
        bags = {entry["method"]: entry["bag"] for entry in results["runs"]}
        with BagReader(Path(folder) / bags["optimal + feedback"]) as reader:
            topics = [name for name, t in reader.topics.items() if t.type_name == ESTIMATE_TYPE]
            took = [message.solve_time for _, _, message in reader.messages(topics)]
    return {
        "graph_replan_median_s": float(np.median(took)),
        "graph_replan_p99_s": float(np.quantile(took, 0.99)),
    }


def _lower_gain(twin: OfflineTwin) -> None:
    twin.twin.gain = 0.8


def _put_on_payload(twin: OfflineTwin) -> None:
    twin.twin.push(Push(twin.twin.time, TIP, mass=0.02))


def _push(twin: OfflineTwin) -> None:
    twin.twin.push(Push(twin.twin.time, TIP, (0.0, 0.3, 0.0), duration=PUSHED))


EVENTS: dict[str, tuple[float, Callable[[OfflineTwin], None]]] = {
    "gain": (0.0, _lower_gain),
    "payload": (INSTANT, _put_on_payload),
    "push": (INSTANT, _push),
}
"""The instant [s] and the doing of each event."""


def _under_events() -> dict[str, float]:
    """Return what each event does to the twin in open loop and with feedback.

    "after" is the mean tip error from 2 s after the event on, "swing" the time until the difference
    to the run without the push has `DIED`.
    """
    limb, _ = calibrate_twin(SEED, Limb.default())
    planned = plan(limb, Motion.named(CASE, period=PERIOD, cycles=1))
    figures: dict[str, float] = {}

    def run(corrected: bool, name: str = "") -> Played:
        twin, waiting = OfflineTwin(SEED), [name] if name else []
        twin.rest(REST)

        def event(instant: float) -> None:
            if waiting and instant >= EVENTS[name][0] - 1e-9:
                EVENTS[waiting.pop()][1](twin)

        return play(planned, twin, Feedback(planned) if corrected else None, event=event)

    for corrected, kind in ((False, "open_loop"), (True, "feedback")):
        calm = run(corrected)
        figures[f"calm_{kind}_m"] = float(calm.error.mean())
        for name, (instant, _) in EVENTS.items():
            played = run(corrected, name)
            since = played.time - instant
            key = f"{name}_{kind}"
            figures[f"{key}_after_m"] = float(played.error[since >= 2.0].mean())
            if name == "push":
                apart = np.linalg.norm(played.tip - calm.tip, axis=1)
                swing = np.nonzero(apart > DIED * apart.max())[0][-1]
                figures[f"{key}_swing_s"] = float(since[swing] - PUSHED)
    return figures


def run(quick: bool = False) -> dict[str, float]:
    """Print and return every figure; ``quick`` leaves the graph out."""
    figures = {} if quick else _on_the_graph()
    figures |= _under_events()
    show(figures)
    return figures
