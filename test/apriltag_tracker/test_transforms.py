"""Clamp, tip and camera as transforms, with and without `tf2_msgs`."""

import sys
from types import SimpleNamespace

import numpy as np
from builtin_interfaces.msg import Time
from scipy.spatial.transform import Rotation

from apriltag_tracker.camera import CameraPose
from apriltag_tracker.pose.node import limb_transforms, transform, transforms_type

STAMP = Time(sec=3, nanosec=5)


def matrix(message) -> np.ndarray:
    turn, place = message.transform.rotation, message.transform.translation
    found = np.eye(4)
    found[:3, :3] = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    found[:3, 3] = place.x, place.y, place.z
    return found


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
    message = transform("overhead", pose.position, pose.rotation.T, STAMP)
    assert message.child_frame_id == "overhead"
    points = np.random.default_rng(2).uniform(-0.2, 0.2, (20, 3))
    inside = (points - matrix(message)[:3, 3]) @ matrix(message)[:3, :3]
    np.testing.assert_allclose(inside, points @ pose.rotation.T + pose.translation, atol=1e-12)


def test_transforms_are_told_where_tf2_is_installed(monkeypatch):
    # A module that is None in sys.modules cannot be imported.
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", None)
    assert transforms_type() is None
    message = SimpleNamespace(TFMessage=SimpleNamespace)
    monkeypatch.setitem(sys.modules, "tf2_msgs", message)
    monkeypatch.setitem(sys.modules, "tf2_msgs.msg", message)
    assert transforms_type() is SimpleNamespace
