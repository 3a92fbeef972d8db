"""Where the camera is, places on tags' planes, and clamp, tip and camera as transforms."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from differences import slopes
from scipy.spatial.transform import Rotation

from apriltag_tracker.camera import CameraPose, project
from apriltag_tracker.detection import Tag
from apriltag_tracker.pose.node import limb_transforms, transform
from apriltag_tracker.pose.shape import centreline_pose
from apriltag_tracker.pose.world import LASTING_ERROR, WorldPose, locate, planar_poses
from apriltag_tracker.tag_map import UNIT_CORNERS, LimbTag


def tags_seen(tags, model, pose, noise=0.0, random=None, moved=None):
    result = []
    for entry in tags.world:
        corners = project(model.intrinsics, pose, entry.corners())
        if moved and entry.id in moved:
            corners = corners + moved[entry.id]
        if random is not None:
            corners = corners + random.normal(0.0, noise, corners.shape)
        result.append(Tag(entry.id, corners, np.eye(8) * 1e-4, 0.02))
    return result


def test_a_bump_is_noticed_and_followed(tags, model):
    world = WorldPose(tags, model.intrinsics)
    for _ in range(40):
        world.update(tags_seen(tags, model, model.pose))
    pushed = CameraPose.looking_down((0.130, 0.006, 0.600), -1.560, (0.030, -0.020))
    poses = [world.update(tags_seen(tags, model, pushed)) for _ in range(5)]
    assert [pose is None for pose in poses] == [True, True, False, False, False]
    pose = poses[-1]
    assert world.bumps == 1
    assert np.allclose(pose.position, pushed.position, atol=1e-6)


def test_one_noisy_frame_is_no_bump(tags, model):
    world, random = WorldPose(tags, model.intrinsics), np.random.default_rng(1)
    for k in range(40):
        moved = {entry.id: 3.0 for entry in tags.world} if k == 20 else None
        pose = world.update(tags_seen(tags, model, model.pose, 0.15, random, moved))
        assert (pose is None) == (k == 20), world.problem
    assert world.bumps == 0


def test_a_fixed_tag_on_the_wrong_place_is_left_out_by_name(tags, model):
    world = WorldPose(tags, model.intrinsics)
    pose = world.update(tags_seen(tags, model, model.pose, moved={103: np.array([6.0, -4.0])}))
    assert list(world.excluded) == [103]
    assert np.allclose(pose.position, model.pose.position, atol=1e-5)


def test_two_of_six_fixed_tags_may_be_wrong_but_most_must_agree(tags, model):
    shifts = np.array([(8.0, -8.0), (-8.0, -8.0)])
    moved = {entry.id: shift for entry, shift in zip(tags.world, shifts, strict=False)}
    world = WorldPose(tags, model.intrinsics)
    world.update(tags_seen(tags, model, model.pose, moved=moved))
    assert set(world.excluded) == set(moved)
    # The calibration of another lens bends the picture outward where this one bends it inward.
    wrong = dataclasses.replace(model.intrinsics, distortion=-model.intrinsics.distortion)
    world = WorldPose(tags, wrong)
    assert world.update(tags_seen(tags, model, model.pose)) is None
    assert "of 6 fixed tags fit together" in world.problem


def test_a_map_that_fits_nothing_gives_no_pose(tags, model):
    random = np.random.default_rng(4)
    shuffled = tuple(
        dataclasses.replace(entry, position=(*random.uniform(-0.3, 0.3, 2), 0.0))
        for entry in tags.world
    )
    world = WorldPose(dataclasses.replace(tags, world=shuffled), model.intrinsics)
    assert world.update(tags_seen(tags, model, model.pose)) is None
    assert world.problem


def test_without_any_fixed_tag_their_ids_and_what_to_compare_are_named(tags, model):
    world = WorldPose(tags, model.intrinsics)
    assert world.update([]) is None
    assert "(100, 101, 102, 103, 104, 105)" in world.problem
    assert "ids and family" in world.problem


def test_the_pose_stays_while_fixed_tags_are_covered(tags, model):
    world = WorldPose(tags, model.intrinsics)
    world.update(tags_seen(tags, model, model.pose))
    for _ in range(50):
        pose = world.update([])
    assert pose is not None


def test_the_pose_covariance_is_that_of_many_pictures(tags, model):
    """Squared errors of many solutions in units of the covariance: 1 a number."""
    random = np.random.default_rng(2)
    nees = []
    for _ in range(60):
        world = WorldPose(dataclasses.replace(tags, world=tags.world[:2]), model.intrinsics)
        lasting = {entry.id: random.normal(0.0, LASTING_ERROR, (4, 2)) for entry in tags.world}
        for _ in range(4):
            seen = tags_seen(tags, model, model.pose, 0.01, random, lasting)
            pose = world.update(seen[:2])
        turn = cv2.Rodrigues(pose.rotation @ model.pose.rotation.T)[0].ravel()
        shift = pose.translation - (pose.rotation @ model.pose.rotation.T) @ model.pose.translation
        error = np.concatenate([turn, shift])
        nees.append(error @ np.linalg.solve(world.covariance, error) / 6.0)
    assert 0.6 < np.mean(nees) < 1.3


# ------------------------------------------------------------------- places on tags' planes


def planar_pose(corners, size):
    """Return pose, derivatives and misfit of one square."""
    return [values[0] for values in planar_poses(corners[None], np.array([size]))]


def square(place, size):
    cosine, sine = np.cos(place[2]), np.sin(place[2])
    return UNIT_CORNERS @ np.array([[cosine, sine], [-sine, cosine]]) * size + place[:2]


def test_a_square_of_another_size_is_a_misfit():
    """A tag 3 cm too low looks 5 % smaller: its corners are off by 5 % of half a diagonal."""
    _, _, misfit = planar_pose(square((0.0, 0.0, 0.3), 0.95 * 0.016), 0.016)
    assert misfit == pytest.approx(0.05 * 0.016 / np.sqrt(2.0))


def test_the_pose_moves_with_the_corners_as_its_derivative_says():
    random = np.random.default_rng(0)
    corners = square((0.1, -0.2, 0.7), 0.016) + random.normal(0.0, 1e-4, (4, 2))
    _, jacobian, _ = planar_pose(corners, 0.016)

    def pose(moved):
        return planar_pose(moved.reshape(4, 2), 0.016)[0]

    assert np.allclose(jacobian, slopes(pose, corners.ravel(), 1e-7), rtol=1e-5, atol=1e-6)


def test_tags_are_placed_at_their_height(model):
    places = np.array([(0.05, 0.03, 0.4), (0.2, -0.1, -2.0)])
    heights, sizes = np.array([0.03, 0.0]), np.array([0.016, 0.02])
    pose = CameraPose.looking_down((0.12, 0.0, 0.6), -1.6, (0.06, -0.05))
    corners = [
        project(model.intrinsics, pose, np.column_stack([square(place, size), np.full(4, height)]))
        for place, size, height in zip(places, sizes, heights, strict=True)
    ]
    noise = np.array([np.eye(8) * 0.02**2] * 2)
    found, _, misfits, _ = locate(np.array(corners), noise, heights, sizes, model.intrinsics, pose)
    assert np.allclose(found, places, atol=1e-9)
    assert misfits.max() < 1e-9


def test_the_mounting_offset_is_taken_off():
    tag = LimbTag(0, 0.1, 0.03, 0.016, (0.002, -0.001, 0.1))
    place = centreline_pose(np.array([1.0, 2.0, np.pi / 2 + 0.1]), tag.offset)
    assert np.allclose(place, (1.0 - 0.001, 2.0 - 0.002, np.pi / 2))


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
