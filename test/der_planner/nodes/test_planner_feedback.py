"""Feedback of the planner node: revisions in time, estimates, lost tags, and slow solutions."""

import threading
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from visualization_msgs.msg import Marker

from der_msgs.msg import LimbState
from der_planner.control import Feedback
from der_planner.estimation.force import untouched
from der_planner.limb import Limb
from der_planner.nodes.planner_feedback import Corrector, _Corrected
from der_planner.nodes.planner_topics import PlannerPublishers
from der_planner.planning import Motion, plan
from der_planner.planning.streaming import Schedule
from limb_interfaces import topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds


@pytest.fixture(scope="module")
def planned():
    return plan(Limb.default(), Motion.named("same_direction", period=6.0), method="projected")


def test_pictures_from_the_future_are_left_out_and_named_once():
    said = []
    now = 1_700_000_000_000_000_000
    corrector = Corrector(None, said.append, lambda: now, lambda _: None)
    taken = []
    corrector._post = taken.append
    for ahead in (9, 30, 31):
        state = LimbState(valid=True, bend_angle=[0.1, 0.1])
        state.header.stamp = stamp_from_nanoseconds(now + ahead * 1_000_000)
        corrector.add_state(state)
    corrector.close()
    assert len(taken) == 1
    (text,) = said
    assert "pictures come from 30 ms in the future" in text


def test_a_plan_from_rest_begins_with_what_the_one_before_has_told():
    corrector = Corrector(Mock(), Mock(), lambda: 0, Mock())
    first, second = Mock(), Mock()
    for feedback in (first, second):
        schedule = Mock(count=5)
        schedule.plan.reference.start = None
        corrector.follow(schedule, feedback)
    begun = corrector._open[-1]
    assert begun.begins(0)
    assert begun.begins(1)
    corrector.close()
    second.remember.assert_called_once_with(first)
    second.take_over.assert_not_called()


def test_a_reaction_holds_however_late_corrections_are():
    held, schedule = np.array([9e3, 7e3]), Mock()
    schedule.plan.differential_pressure = np.full((100, 2), 13e3)
    schedule.plan.limb.pneumatics.pressure_limit = 24e3
    feedback = Mock(allowed=lambda _: held)
    feedback.coming.return_value = (5, np.full((10, 2), -4e3))
    corrected = _Corrected(schedule, feedback, None, None)
    for index in (3, 6, 60):  # before the newest solution, in it, and long after it
        np.testing.assert_array_equal(corrected.pressures(index), held)


def test_the_end_of_a_motion_ends_its_touch_and_says_why_it_vented():
    output, schedule, feedback = Mock(), Mock(), Mock()
    feedback.touch = replace(untouched(3.0, np.zeros(2)), touched=True, said="0.21 N")
    corrector = Corrector(output, Mock(), lambda: 0, Mock())
    corrector.follow(schedule, feedback)
    each = corrector._open[-1]
    each.touching = each.vented = True
    said = corrector.forget(schedule)
    assert "the reaction is to vent): 0.21 N" in said
    ((_, told),) = [call.args for call in output.contact.call_args_list]
    assert not told.touched
    assert "the motion has ended" in told.said
    assert corrector.forget(schedule) == ""
    corrector.close()


def test_a_touch_is_published_and_drawn_while_it_lasts(planned):
    sent = {}
    node = Mock()
    node.create_publisher = lambda _, topic, __: Mock(
        publish=lambda message: sent.update({topic: message})
    )
    node.get_clock().now().to_msg.return_value = stamp_from_nanoseconds(0)
    output = PlannerPublishers(node)
    schedule = Schedule("touched", planned, 1_000_000_000)
    nothing = untouched(2.0, np.zeros(2))
    found = replace(
        nothing, touched=True, since=1.5, place=0.1, force=np.array([0.0, 0.3]),
        pressure=np.array([500.0, 0.0]), force_covariance=0.01 * np.eye(2), said="0.30 N",
    )  # fmt: skip
    output.contact(schedule, found)
    told, (arrow,) = sent[topics.CONTACT], sent[topics.SHAPE_MARKERS].markers
    assert (told.touched, told.said, told.arc_length) == (True, "0.30 N", 0.1)
    assert nanoseconds(told.header.stamp) == 3_000_000_000
    assert nanoseconds(told.since) == 2_500_000_000
    assert told.point.x == pytest.approx(0.1)
    assert arrow.action == Marker.ADD
    np.testing.assert_allclose([arrow.points[0].x, arrow.points[0].y], [0.1, -0.03], atol=1e-6)
    output.contact(schedule, nothing)
    assert not sent[topics.CONTACT].touched
    assert sent[topics.SHAPE_MARKERS].markers[0].action == Marker.DELETE


def test_a_solution_that_takes_too_long_holds_nothing_up_and_is_not_sent(planned):
    now, output, feedback = [1_700_000_000_000_000_000], Mock(), Feedback(planned)
    busy, released, taken_back = (threading.Event() for _ in range(3))

    def command(instant):
        busy.set()
        released.wait(60.0)
        now[0] += 300_000_000
        return Feedback.command(feedback, instant)

    def warn(text):
        if "late" in text:
            taken_back.set()

    feedback.command = command
    corrector = Corrector(output, warn, lambda: now[0], Mock())
    schedule = Schedule("slow", planned, now[0] - 1_000_000_000)
    corrector.follow(schedule, feedback)
    assert busy.wait(60.0)
    # It hangs in its first command; a setpoint's pressures are there all the same.
    np.testing.assert_array_equal(
        corrector.pressures(schedule, 30), planned.differential_pressure[30]
    )
    assert not released.is_set()
    released.set()
    assert taken_back.wait(60.0)
    corrector.close()
    assert feedback.reason == "late"
    output.setpoint.assert_not_called()
