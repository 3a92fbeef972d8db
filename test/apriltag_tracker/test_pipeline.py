from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from apriltag_tracker.detection import Detector
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.pose.shape import FollowerOptions, Uncertainty
from apriltag_tracker.synthetic.camera import Optics, SyntheticCamera

pytestmark = pytest.mark.slow

PERIOD = 1.0 / 30.0


def run(tracker, camera, swing, frames, start=0):
    errors, observations = [], []
    for k in range(start, start + frames):
        time = k * PERIOD
        frame = camera.frame(swing.shape(time), swing.velocity(time))
        observation = tracker.observe(frame.image, time)
        observations.append(observation)
        if observation.estimate is not None:
            errors.append(observation.estimate.tip - swing.shape(time).points[-1])
    return np.array(errors), observations


def test_the_tip_is_within_a_tenth_of_a_millimetre(plain, model, camera, swing):
    tracker = LimbTracker(plain, model.intrinsics)
    errors, observations = run(tracker, camera, swing, 45)
    assert len(errors) == 45
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 1e-4
    assert all(observation.reason == "" for observation in observations)
    normalised = [
        error @ np.linalg.solve(each.estimate.tip_covariance, error)
        for error, each in zip(errors, observations, strict=True)
    ]
    # Two degrees of freedom: the mean is 2 where the covariance is honest.
    assert 0.3 < np.mean(normalised) < 8.0


def test_the_tip_is_as_sure_as_it_says_with_few_fixed_tags(plain, model, swing):
    """Squared error a number, in units of the covariance, in the first pictures of many starts."""
    order, detector = (1, 4, 0, 3, 2, 5), Detector()
    nees = {1: [], 2: [], 6: []}
    for seed in range(40, 52):
        shape, velocity = swing.shape(seed * PERIOD), swing.velocity(seed * PERIOD)
        camera = SyntheticCamera(model, plain, Optics(), seed=seed)
        image = camera.frame(shape, velocity).image
        for count, found in nees.items():
            world = tuple(plain.world[k] for k in order[:count])
            tags = dataclasses.replace(plain, world=world)
            tracker = LimbTracker(tags, model.intrinsics, detector=detector)
            estimate = tracker.observe(image, seed * PERIOD).estimate
            error = estimate.tip - shape.points[-1]
            found.append(error @ np.linalg.solve(estimate.tip_covariance, error) / 2.0)
    assert all(0.4 < np.mean(found) < 2.0 for found in nees.values()), nees


def test_set_up_errors_stay_within_the_systematic_part(plain, model, swing):
    uncertainty = Uncertainty(survey=5e-4, height=0.0, mounting=4e-4, mounting_angle=5e-3)
    options = FollowerOptions(uncertainty=uncertainty, reject_beyond=0.01)
    normalised = []
    for seed in range(8):
        random = np.random.default_rng(seed)
        limb = [
            dataclasses.replace(tag, offset=random.normal(0.0, [4e-4, 4e-4, 5e-3]))
            for tag in plain.limb
        ]
        world = [
            dataclasses.replace(tag, position=random.normal(tag.position, [5e-4, 5e-4, 0.0]))
            for tag in plain.world
        ]
        really = dataclasses.replace(plain, limb=tuple(limb), world=tuple(world))
        camera = SyntheticCamera(model, really, Optics(), seed=seed)
        tracker = LimbTracker(plain, model.intrinsics, options)
        error, observations = run(tracker, camera, swing, 2, start=20)
        spread = observations[-1].estimate.tip_systematic
        normalised.append(error[-1] @ np.linalg.solve(spread, error[-1]))
    assert 0.4 < np.mean(normalised) < 5.0


def test_without_fixed_tags_nothing_is_placed(plain, model, swing):
    bare = dataclasses.replace(plain, world=())
    camera = SyntheticCamera(model, bare)
    tracker = LimbTracker(plain, model.intrinsics)
    observation = tracker.observe(camera.frame(swing.shape(0.0)).image, 0.0)
    assert observation.estimate is None
    assert "no fixed tag" in observation.reason
    assert len(observation.tags) == len(bare.limb)
    assert all(placed.pose is None for placed in observation.tags)


def test_tags_at_another_height_or_place_are_left_out_by_name(plain, model, swing):
    limb = list(plain.limb)
    limb[1] = dataclasses.replace(limb[1], arc_length=0.085)
    limb[3] = dataclasses.replace(limb[3], height=-0.09)
    camera = SyntheticCamera(model, dataclasses.replace(plain, limb=tuple(limb)))
    tracker = LimbTracker(plain, model.intrinsics)
    observation = tracker.observe(camera.frame(swing.shape(0.3)).image, 0.0)
    assert observation.estimate.tags_used == (0, 2, 4)
    assert "wrong place, left out: 1" in observation.reason
    assert tracker.follower.misplaced == 1
    error = observation.estimate.tip - swing.shape(0.3).points[-1]
    assert np.hypot(*error) < 1e-3
