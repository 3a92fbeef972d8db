from __future__ import annotations

import dataclasses

import cv2
import numpy as np

from apriltag_tracker.camera import CameraPose, project
from apriltag_tracker.detection import Tag
from apriltag_tracker.pose.world import LASTING_ERROR, WorldPose


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
    for _ in range(5):
        pose = world.update(tags_seen(tags, model, pushed))
    assert world.bumps == 1
    assert np.allclose(pose.position, pushed.position, atol=1e-6)


def test_one_noisy_frame_is_no_bump(tags, model):
    world = WorldPose(tags, model.intrinsics)
    for k in range(40):
        moved = {entry.id: 3.0 for entry in tags.world} if k == 20 else None
        world.update(tags_seen(tags, model, model.pose, moved=moved))
    assert world.bumps == 0


def test_a_fixed_tag_on_the_wrong_place_is_left_out_by_name(tags, model):
    world = WorldPose(tags, model.intrinsics)
    pose = world.update(tags_seen(tags, model, model.pose, moved={103: np.array([6.0, -4.0])}))
    assert list(world.excluded) == [103]
    assert np.allclose(pose.position, model.pose.position, atol=1e-5)


def test_a_map_that_fits_nothing_gives_no_pose(tags, model):
    random = np.random.default_rng(4)
    shuffled = tuple(
        dataclasses.replace(entry, position=(*random.uniform(-0.3, 0.3, 2), 0.0))
        for entry in tags.world
    )
    world = WorldPose(dataclasses.replace(tags, world=shuffled), model.intrinsics)
    assert world.update(tags_seen(tags, model, model.pose)) is None
    assert world.problem


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
