"""Clamp, tip and camera as transforms, with and without `tf2_msgs`."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from scipy.spatial.transform import Rotation

from apriltag_tracker.camera import CameraPose
from limb_interfaces.transforms import (
    TransformPublisher,
    camera_transform,
    limb_transforms,
    quaternion,
)

STAMP = Time(sec=3, nanosec=5)


def matrix(message) -> np.ndarray:
    turn, place = message.transform.rotation, message.transform.translation
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    found[:3, 3] = place.x, place.y, place.z
    return found


def test_quaternions_are_those_of_scipy_also_for_half_turns():
    turns = [*Rotation.random(200, random_state=1).as_matrix()]
    turns += [np.diag(signs) for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1), (1, 1, 1))]
    for turn in turns:
        found = np.array(quaternion(np.asarray(turn, dtype=float)))
        assert found[3] >= 0.0
        np.testing.assert_allclose(Rotation.from_quat(found).as_matrix(), turn, atol=1e-12)


def test_the_tip_is_where_the_curve_ends_and_looks_along_it():
    angle = np.linspace(0.0, 2.0, 500)
    curve = 0.1 * np.stack([np.sin(angle), 1.0 - np.cos(angle)], axis=1)
    clamp, tip = limb_transforms(curve, STAMP)
    assert (clamp.child_frame_id, tip.child_frame_id) == ("limb_clamp", "limb_tip")
    assert {clamp.header.frame_id, tip.header.frame_id} == {"limb_base"}
    assert tip.header.stamp == STAMP
    np.testing.assert_allclose(matrix(clamp), np.eye(4))
    np.testing.assert_allclose(matrix(tip)[:2, 3], curve[-1])
    np.testing.assert_allclose(matrix(tip)[:2, 0], [np.cos(2.0), np.sin(2.0)], atol=3e-3)


def test_points_of_the_base_are_seen_where_the_camera_sees_them():
    pose = CameraPose.looking_down((0.1, -0.05, 0.9), 0.3, (0.02, -0.04))
    message = camera_transform(pose.rotation, pose.translation, STAMP, "overhead")
    assert message.child_frame_id == "overhead"
    points = np.random.default_rng(2).uniform(-0.2, 0.2, (20, 3))
    inside = (points - matrix(message)[:3, 3]) @ matrix(message)[:3, :3]
    np.testing.assert_allclose(inside[:, :2] / inside[:, 2:], pose.normalised(points), atol=1e-12)
    assert camera_transform(np.eye(3), np.zeros(3), STAMP).child_frame_id == "limb_camera"


class RecordingNode:
    """Notes what is published; a fake message has no type support for a real publisher."""

    def __init__(self):
        self.topics, self.sent = [], []

    def create_publisher(self, message, topic, _profile):
        self.topics.append((message, topic))
        return SimpleNamespace(publish=self.sent.append)


@pytest.fixture
def tf2_msgs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Install a package of that name."""
    (tmp_path / "tf2_msgs").mkdir()
    (tmp_path / "tf2_msgs" / "__init__.py").touch()
    (tmp_path / "tf2_msgs" / "msg.py").write_text(
        "class TFMessage:\n    def __init__(self, transforms):\n"
        "        self.transforms = transforms\n"
    )
    for name in ("tf2_msgs", "tf2_msgs.msg"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for name in ("tf2_msgs", "tf2_msgs.msg"):
        sys.modules.pop(name, None)


def test_transforms_are_published_where_tf2_is_installed(tf2_msgs):
    node = RecordingNode()
    publisher = TransformPublisher(node)
    transforms = limb_transforms(np.array([[0.0, 0.0], [0.2, 0.1]]), STAMP)
    publisher.publish(transforms)
    publisher.publish([])
    assert publisher.active
    assert [(kind.__name__, topic) for kind, topic in node.topics] == [("TFMessage", "/tf")]
    assert [message.transforms for message in node.sent] == [transforms]


def test_without_tf2_nothing_is_published_and_nothing_fails(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_msgs", None)
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)
    node = RecordingNode()
    publisher = TransformPublisher(node)
    publisher.publish(limb_transforms(np.array([[0.0, 0.0], [0.2, 0.1]]), STAMP))
    assert not publisher.active
    assert node.topics == node.sent == []
