"""Poses in the messages of other trackers."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, TransformStamped

from apriltag_tracker.bodies.forms import PoseFormError, message_type, poses_of, topics_of

NAMES = ("clamp", "tip")
STAMP = Time(sec=2, nanosec=5)
HEADER = SimpleNamespace(stamp=STAMP)


def pose(x: float) -> Pose:
    found = Pose()
    found.position.x, found.orientation.w = x, 1.0
    return found


def transform(name: str, x: float) -> TransformStamped:
    found = TransformStamped(child_frame_id=name)
    found.header.stamp = STAMP
    found.transform.translation.x, found.transform.rotation.w = x, 1.0
    return found


def named(name: str, x: float) -> SimpleNamespace:
    return SimpleNamespace(name=name, pose=pose(x))


# Two of the types are of packages that are not installed here.
MESSAGES = {
    "pose_array": PoseArray(poses=[pose(1.0), pose(2.0)]),
    "tf": SimpleNamespace(transforms=[transform("clamp", 1.0), transform("tip", 2.0)]),
    "named_pose_array": SimpleNamespace(
        header=HEADER, poses=[named("clamp", 1.0), named("tip", 2.0)]
    ),
}
MESSAGES["pose_array"].header.stamp = STAMP


@pytest.mark.parametrize("form", MESSAGES)
def test_all_bodies_of_a_message_are_told(form):
    found = list(poses_of(form, MESSAGES[form], "", NAMES))
    assert [each.name for each in found] == list(NAMES)
    assert {each.stamp for each in found} == {2_000_000_005}
    assert [each.pose for each in found] == [(x, 0, 0, 0, 0, 0, 1) for x in (1.0, 2.0)]


def test_a_topic_of_its_own_names_the_body():
    message = PoseStamped(pose=pose(3.0))
    assert list(poses_of("pose_stamped", message, "tip", NAMES)) == [
        ("tip", 0, (3.0, 0, 0, 0, 0, 0, 1))
    ]
    assert topics_of("pose_stamped", "", NAMES)["tip"] == "poses/tip/pose"
    with pytest.raises(PoseFormError, match=r"\{body\}"):
        topics_of("pose_stamped", "poses", NAMES)


def test_what_cannot_be_is_refused_with_the_remedy(monkeypatch):
    with pytest.raises(PoseFormError, match="array of 2 poses came, the body map has 1 bodies"):
        list(poses_of("pose_array", MESSAGES["pose_array"], "", NAMES[:1]))
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces.msg", None)
    with pytest.raises(PoseFormError, match="install ros-jazzy-motion-capture-tracking-interfaces"):
        message_type("named_pose_array")
