"""Poses as messages of other trackers: what goes out in a form comes back as the same frame."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.forms import (
    FORMS,
    PoseFormError,
    PoseSubscriber,
    pose_messages,
    topics_of,
)
from apriltag_tracker.bodies.tracker import PoseFrame


class FakeMessage(SimpleNamespace):
    """A message of a package that is not installed here."""

    def __init__(self, **values):
        stamp = SimpleNamespace(sec=0, nanosec=0)
        super().__init__(header=SimpleNamespace(stamp=stamp, frame_id=""), **values)


@pytest.fixture
def other_packages(monkeypatch):
    """Have `tf2_msgs` and `motion_capture_tracking_interfaces` installed."""
    for name, kinds in (
        ("tf2_msgs", ("TFMessage",)),
        ("motion_capture_tracking_interfaces", ("NamedPose", "NamedPoseArray")),
    ):
        module = SimpleNamespace(**dict.fromkeys(kinds, FakeMessage))
        monkeypatch.setitem(sys.modules, name, SimpleNamespace(msg=module))
        monkeypatch.setitem(sys.modules, f"{name}.msg", module)


class FakeNode:
    """Keeps what subscribes to which topic."""

    def __init__(self):
        self.listeners = {}

    def get_clock(self):
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=77))

    def create_subscription(self, kind, topic, take, profile):
        self.listeners[topic] = take


@pytest.fixture
def bodies(config) -> BodyMap:
    return BodyMap.from_yaml(config / "bodies.yaml")


def frames(bodies, count):
    random = np.random.default_rng(1)
    size = len(bodies.names)
    turns = random.standard_normal((count, size, 4))
    turns /= np.linalg.norm(turns, axis=2, keepdims=True)
    return [
        PoseFrame(1_000_000_000 + 10_000_000 * k, random.standard_normal((size, 3)), turns[k])
        for k in range(count)
    ]


@pytest.mark.parametrize("form", FORMS)
def test_a_frame_comes_back_as_it_went_out(form, bodies, other_packages):
    node, taken = FakeNode(), []
    reader = PoseSubscriber(node, form, "", bodies, taken.append)
    sent = frames(bodies, 4)
    for frame in sent:
        for name, message in pose_messages(form, bodies.names, frame, "mocap").items():
            node.listeners[reader.topics[name]](message)
    assert [frame.stamp for frame in taken] == [frame.stamp for frame in sent]
    for came, went in zip(taken, sent, strict=True):
        assert np.array_equal(came.positions, went.positions)
        assert np.array_equal(came.quaternions, went.quaternions)


def test_an_array_of_another_size_is_told(bodies):
    node, taken = FakeNode(), []
    reader = PoseSubscriber(node, "pose_array", "mocap/poses", bodies, taken.append)
    message = pose_messages("pose_array", bodies.names, frames(bodies, 1)[0], "mocap")[""]
    message.poses = message.poses[:-1]
    node.listeners["mocap/poses"](message)
    assert "array of 7 poses came, the body map has 8 bodies" in reader.wrong_size
    assert not taken


def test_a_form_that_cannot_be_is_refused_with_the_remedy(bodies, monkeypatch):
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces", None)
    monkeypatch.setitem(sys.modules, "motion_capture_tracking_interfaces.msg", None)
    with pytest.raises(PoseFormError, match="install ros-jazzy-motion-capture-tracking-interfaces"):
        PoseSubscriber(FakeNode(), "named_pose_array", "", bodies, list)
    with pytest.raises(PoseFormError, match=r"\{body\}"):
        topics_of("pose_stamped", "poses", bodies.names)
