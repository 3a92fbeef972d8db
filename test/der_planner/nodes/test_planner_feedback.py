"""Feedback of the planner node: revisions in time, estimates, lost tags, and slow solutions."""

import threading

import numpy as np
import pytest

pytestmark = pytest.mark.graph


def test_pictures_from_the_future_are_left_out_and_named_once():
    from der_msgs.msg import LimbState
    from der_planner.nodes.planner_feedback import Corrector
    from limb_interfaces.stamps import stamp_from_nanoseconds

    said = []
    corrector = Corrector(None, said.append, lambda: 1_700_000_000_000_000_000)
    taken = []
    corrector._post = taken.append
    for ahead in (9, 30, 31):
        state = LimbState(valid=True, bend_angle=[0.1, 0.1])
        state.header.stamp = stamp_from_nanoseconds(1_700_000_000_000_000_000 + ahead * 1_000_000)
        corrector.add_state(state)
    corrector.close()
    assert len(taken) == 1
    (text,) = said
    assert "pictures come from 30 ms in the future" in text


def test_solutions_that_take_too_long_never_hold_up_the_plan():
    """Every command comes too late: setpoints go out meanwhile, and then the plan is left alone."""
    from der_msgs.msg import LimbState
    from der_planner.control import Feedback
    from der_planner.limb import Limb
    from der_planner.nodes.planner_feedback import Corrector
    from der_planner.planning import Motion, plan
    from der_planner.planning.streaming import Schedule
    from limb_interfaces.stamps import stamp_from_nanoseconds

    class Slow(Feedback):
        def __init__(self, plan):
            super().__init__(plan)
            self.busy, self.released = threading.Event(), threading.Event()

        def command(self, instant):
            self.busy.set()
            self.released.wait(60.0)
            now[0] += 300_000_000
            return super().command(instant)

    class Output:
        def setpoint(self, schedule, index, pressures, revision):
            said.append("revised")

        def estimate(self, *arguments, **about):
            pass

        contact = estimate

    said, taken_back = [], threading.Event()
    now = [1_700_000_000_000_000_000]

    def warn(text):
        said.append(text)
        if "late" in text:
            taken_back.set()

    motion = Motion.named("same_direction", period=60.0, cycles=2)
    planned = plan(Limb.default(), motion, method="projected")
    slow = Slow(planned)
    corrector = Corrector(Output(), warn, lambda: now[0], lambda _: None)
    schedule = Schedule("slow", planned, now[0] - 1_000_000_000)
    corrector.follow(schedule, slow)
    assert slow.busy.wait(60.0)
    # It hangs in its first command; a setpoint's pressures are there all the same.
    np.testing.assert_array_equal(
        corrector.pressures(schedule, 30), planned.differential_pressure[30]
    )
    assert not slow.released.is_set()
    slow.released.set()
    for _ in range(3000):
        state = LimbState(valid=True, bend_angle=[0.1, 0.1])
        state.header.stamp = stamp_from_nanoseconds(now[0])
        corrector.add_state(state)
        if taken_back.wait(0.02):
            break
    corrector.close()
    assert taken_back.is_set()
    assert "revised" not in said
    assert slow.reason == "late"
