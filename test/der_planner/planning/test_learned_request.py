"""A command of the method learned: which plan the planner takes, and which it refuses."""

from types import SimpleNamespace

import numpy as np
import pytest

from der_msgs.msg import MotionCommand
from der_planner.limb import Limb
from der_planner.nodes.planner_requests import from_command
from der_planner.planning import Motion, plan
from der_planner.planning.plan_file import write_plan


def test_a_learned_plan_is_named_in_place_of_the_motion(tmp_path):
    limb = Limb.default()
    motion = Motion.named("asynchronous", amplitude=0.3, period=3.0, cycles=1)
    kept = plan(limb, motion, method="projected")
    write_plan(kept, tmp_path / "mine.yaml")
    options = SimpleNamespace(
        limb=limb, payload=0.0, payload_at=0.0, learned_plans=str(tmp_path),
        model="der", method="", branch="", feedback=False,
    )  # fmt: skip
    request = from_command(MotionCommand(motion="mine", method="learned"), options, 0)
    assert (request.method, request.motion.name) == ("learned", "asynchronous")
    assert np.array_equal(request.learned.differential_pressure, kept.differential_pressure)
    for fields, said in (
        ({"motion": "none"}, "no learned plan 'none'"),
        ({"motion": "mine", "payload": 0.02}, "another masses"),
    ):
        with pytest.raises(ValueError, match=said):
            from_command(MotionCommand(method="learned", **fields), options, 0)
