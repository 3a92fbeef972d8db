"""What unannounced events do to a calibrated twin in open loop and with feedback, in lock-step.

A gain 20 % lower from the start, 20 g put on the tip at mid-run, and a push of 0.3 N on the tip for
0.2 s. "after" is the mean tip error from two seconds after the event on, "back" the time from the
event until the tip stays within 1 % of the limb's length, "swing" the time until the difference to
the same run without the push has died to a fifth.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from der_planner.control.feedback import Feedback
from der_planner.control.lockstep import Played, play
from der_planner.limb import Limb
from der_planner.model.series import CONTROL_PERIOD
from der_planner.planning import Motion, plan
from der_planner.twin.loads import Push
from der_planner.twin.offline import OfflineTwin

PERIOD = 20.0
CASE = "asynchronous"
INSTANT = 8.0
"""Of payload and push [s]."""
TIP = 0.244
"""Arc length of the twin's tip [m]."""
_PUSHED = 0.2
_NEAR = 0.01
_DIED = 0.2
_REST = 1.0


def _gain(twin: OfflineTwin) -> None:
    twin.twin.gain = 0.8


def _payload(twin: OfflineTwin) -> None:
    twin.twin.push(Push(twin.twin.time, TIP, mass=0.02))


def _push(twin: OfflineTwin) -> None:
    push = Push(twin.twin.time, TIP, (0.0, 0.3, 0.0), duration=_PUSHED)
    twin.twin.push(push)


EVENTS: dict[str, tuple[float, Callable[[OfflineTwin], None]]] = {
    "gain": (0.0, _gain),
    "payload": (INSTANT, _payload),
    "push": (INSTANT, _push),
}


def measure(limb: Limb, seed: int) -> dict[str, float]:
    """Print and return what each event does to the twin of a seed, by its calibrated limb."""
    planned = plan(limb, Motion.named(CASE, period=PERIOD, cycles=1))
    near = _NEAR * sum(segment.length for segment in limb.segments)
    figures: dict[str, float] = {}

    def run(corrected: bool, name: str = "") -> Played:
        twin, waiting = OfflineTwin(seed), [name] if name else []
        twin.rest(_REST)

        def event(time: float) -> None:
            if waiting and time >= EVENTS[name][0] - 1e-9:
                EVENTS[waiting.pop()][1](twin)

        return play(planned, twin, Feedback(planned) if corrected else None, event=event)

    for corrected, way in ((False, "open_loop"), (True, "feedback")):
        calm = run(corrected)
        for name, (instant, _) in EVENTS.items():
            played = run(corrected, name)
            since = played.time - instant
            late = np.nonzero((played.error > near) & (since > 0))[0]
            key = f"{name}_{way}"
            figures[f"{key}_after_m"] = float(played.error[since >= 2.0].mean())
            figures[f"{key}_back_s"] = float(since[late[-1]] + CONTROL_PERIOD) if len(late) else 0.0
            told = ""
            if name == "push":
                apart = np.linalg.norm(played.tip - calm.tip, axis=1)
                swing = np.nonzero(apart > _DIED * apart.max())[0][-1]
                figures[f"{key}_swing_s"] = float(since[swing] - _PUSHED)
                told = f", swing {since[swing] - _PUSHED:.2f} s"
            print(
                f"  {name:<8} {way:<10} after {100 * figures[f'{key}_after_m']:.3f} cm, "
                f"back {figures[f'{key}_back_s']:.2f} s{told}",
                flush=True,
            )
    return figures
