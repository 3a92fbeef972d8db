"""Commands of the method learned and along paths: what is planned, and what is refused."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from geometry_msgs.msg import Point
from nav_msgs.msg import Path

from der_msgs.msg import MotionCommand
from der_planner.limb import Limb
from der_planner.nodes.planner_requests import from_command, from_path, start_of
from der_planner.planning import Motion, PathLimits, plan
from der_planner.planning.plan_file import write_plan
from limb_interfaces.stamps import NANOSECONDS

LIMB = Limb.default()


def options(limb=LIMB, **changes):
    """Return the parameters that requests are read with."""
    given = {
        "payload": 0.0, "payload_at": 0.0, "learned_plans": "", "default_model": "der",
        "default_method": "", "branch": "", "feedback": False, "limits": PathLimits(),
        "nearest_path": False,
    }  # fmt: skip
    return SimpleNamespace(limb=limb, **{**given, **changes})


def test_a_learned_plan_is_named_in_place_of_the_motion(tmp_path):
    motion = Motion.named("asynchronous", amplitude=0.3, period=3.0, cycles=1)
    kept = plan(LIMB, motion, method="projected")
    write_plan(kept, tmp_path / "mine.yaml")
    given = options(learned_plans=str(tmp_path))
    request = from_command(MotionCommand(motion="mine", method="learned"), given, 0)
    assert (request.method, request.motion.name) == ("learned", "asynchronous")
    assert np.array_equal(request.learned.differential_pressure, kept.differential_pressure)
    for fields, said in (
        ({"motion": "none"}, "no learned plan 'none'"),
        ({"motion": "mine", "payload": 0.02}, "another masses"),
    ):
        with pytest.raises(ValueError, match=said):
            from_command(MotionCommand(method="learned", **fields), given, 0)


def test_a_command_may_carry_a_path_with_a_load_of_its_own():
    path = [Point(x=0.2, y=0.08), Point(x=0.22, y=0.05)]
    command = MotionCommand(path=path, model="pcc", payload=0.02, mounting="hanging")
    request = from_command(command, options(), 0)
    assert request.limb == LIMB.mounted("hanging").carrying(0.02)
    assert (request.motion.name, request.model, request.motion.nearest) == ("path", "pcc", False)
    command.nearest_path = True
    assert from_command(command, options(), 0).motion.nearest
    for fields, said in (
        ({"motion": "asynchronous"}, "give one of them"),
        ({"method": "learned"}, "give one of them"),
        ({"path": path[:1]}, "two or more points"),
        ({"path": [Point(x=math.nan), path[0]]}, "not finite"),
    ):
        with pytest.raises(ValueError, match=said):
            from_command(MotionCommand(**{"path": path, **fields}), options(), 0)


def test_each_command_has_the_loads_of_its_time():
    """Those that it names, else those of the parameters."""
    limb = LIMB.mounted("hanging")
    given = options(limb, payload=0.02, default_model="pcc")

    def loaded(**fields) -> Limb:
        return from_command(MotionCommand(motion="asynchronous", **fields), given, 0).limb

    assert loaded() == limb.carrying(0.02)
    assert loaded(payload=0.05, payload_at=0.2) == limb.carrying(0.05, 0.2)
    tilted = loaded(payload=0.03, mounting="10")
    assert tilted.payload == (0.03, 0.0)
    assert tilted.gravity[:2] == (0.0, pytest.approx(-1.7035, abs=1e-4))
    with pytest.raises(ValueError, match=r"must be at least 0 kg, got -0\.1"):
        loaded(payload=-0.1)


@pytest.mark.parametrize(
    ("ahead", "said"), [(-1.6e9, "s ago"), (2.2e8, "s ahead"), (-5.0, ""), (300.0, "")]
)
def test_a_start_in_another_epoch_is_refused(ahead, said):
    now = 1_700_000_000 * NANOSECONDS
    wanted = now + round(ahead * NANOSECONDS)
    if not said:
        assert start_of(wanted, now) == wanted
        return
    with pytest.raises(ValueError, match=said):
        start_of(wanted, now)


def test_a_path_in_another_frame_is_refused():
    message = Path()
    message.header.frame_id = "map"
    with pytest.raises(ValueError, match="frame 'map'"):
        from_path(message, "path", options(), 0)
