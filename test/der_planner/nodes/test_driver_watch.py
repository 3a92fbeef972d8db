"""What the planner concludes from the driver's states: whom it streams to, and when it stops."""

import pytest

from der_msgs.msg import PressureState
from der_planner.nodes.planner_topics import DriverWatch

DISARMED, ARMED, TRACKING = PressureState.DISARMED, PressureState.ARMED, PressureState.TRACKING
HOLDING, VENTING, FAULT = PressureState.HOLDING, PressureState.VENTING, PressureState.FAULT


def watch(*modes, begun=("mine",), plan_id="mine", time=lambda: 0.0):
    """Return a watch that has heard these modes, and why its last one ends a plan."""
    found, ending = DriverWatch(time, timeout=1.0), None
    for mode in modes:
        state = PressureState(mode=mode, plan_id=plan_id, faults=["low supply"])
        ending = found.update(state, begun)
    return found, ending


@pytest.mark.parametrize(
    ("modes", "ends", "obstacle"),
    [
        ((), None, None),
        ((ARMED, TRACKING), None, None),
        ((TRACKING, HOLDING), None, None),
        ((DISARMED,), "vented", "the driver is DISARMED: arm the driver"),
        ((TRACKING, FAULT), "fault", "in FAULT (low supply): remove the cause"),
        ((TRACKING, VENTING), "vented", "the driver is VENTING: wait"),
        ((TRACKING, HOLDING, VENTING), "vented", None),
    ],
)
def test_what_ends_a_plan_and_what_keeps_the_next_one_back(modes, ends, obstacle):
    found, ending = watch(*modes)
    assert (ending.outcome if ending else None) == ends
    said = found.obstacle()
    assert (obstacle in said.reason) if obstacle else (said is None)


def test_a_ramp_down_after_an_earlier_plan_does_not_concern_the_next_one():
    found, ending = watch(TRACKING, HOLDING, VENTING, begun=("next",), plan_id="last")
    assert ending is None
    assert found.obstacle() is None


def test_setpoints_that_the_driver_refused_are_counted_once_and_anew_for_a_new_driver():
    found = DriverWatch(lambda: 0.0, timeout=1.0)
    for told, new in ((7, 7), (158, 151), (158, 0), (2, 0), (5, 3)):
        found.update(PressureState(mode=TRACKING, setpoints_refused=told), ())
        assert found.newly_refused() == new


def test_a_driver_that_falls_silent_is_lost_and_one_that_was_never_heard_is_not():
    now = [0.0]
    found, _ = watch(ARMED, time=lambda: now[0])
    silent, _ = watch(time=lambda: now[0])
    now[0] = 1.5
    assert found.obstacle().outcome == "lost"
    assert "has said nothing for 1.5 s" in found.obstacle().reason
    assert silent.obstacle() is None
    assert (found.mode, silent.mode) == ("ARMED", "")


def test_a_state_that_is_older_than_the_motion_ends_nothing():
    found, late = DriverWatch(lambda: 0.0, timeout=1.0), PressureState(mode=DISARMED)
    late.header.stamp.sec = 9
    assert found.update(late, (), asked=10_000_000_000) is None
    assert found.obstacle() is None
    late.header.stamp.sec = 10
    assert found.update(late, (), asked=10_000_000_000).outcome == "vented"
