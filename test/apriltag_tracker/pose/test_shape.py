"""The limb's shape from its tags, and its clamp where the map has it elsewhere."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
import yaml
from differences import slopes
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.pose.clamp import Clamp, at_clamp, find_clamp
from apriltag_tracker.pose.curve import Curve, Evaluation
from apriltag_tracker.pose.following import LimbFollower
from apriltag_tracker.pose.shape import (
    FollowerOptions,
    PlanarTag,
    ShapeFitter,
    ShapePrior,
)
from apriltag_tracker.synthetic.shapes import Shape, constant_curvature
from apriltag_tracker.tag_map import TagMap

NOISE = np.diag([2e-5, 2e-5, 1e-3]) ** 2


def seen(tags, shape: Shape, random=None) -> list[PlanarTag]:
    result = []
    for tag in tags.limb:
        pose = shape.at(tag.arc_length)
        if random is not None:
            pose = pose + random.multivariate_normal(np.zeros(3), NOISE)
        result.append(PlanarTag(tag.id, tag.arc_length, pose, NOISE))
    return result


@pytest.mark.parametrize(
    ("bends", "elongation"),
    [((0.0, 0.0), 1.0), ((0.87, 0.87), 1.0), ((0.87, -0.87), 1.02), ((-1.2, 0.3), 0.98)],
)
def test_arcs_are_recovered(plain, bends, elongation):
    shape = constant_curvature(plain.segment_lengths, bends, points=2001)
    shape = dataclasses.replace(shape, points=elongation * shape.points)
    estimate = ShapeFitter(plain).fit(seen(plain, shape))
    assert np.allclose(estimate.tip, shape.points[-1], atol=2e-6)
    assert np.allclose(estimate.bend_angle, bends, atol=2e-3)
    assert estimate.elongation == pytest.approx(elongation, abs=1e-4)
    assert estimate.residual < 1e-4
    assert np.allclose(estimate.curve[0], 0.0, atol=1e-5)
    assert estimate.rejected == {}


def test_derivatives_agree_with_finite_differences(tags):
    curve = Curve(tags.segment_lengths, 3, tags.stiff)
    evaluation = Evaluation(curve, [0.01, 0.122, 0.2, 0.244])
    random = np.random.default_rng(0)
    parameters = random.normal(0.0, 1.0, curve.size) * 0.3
    parameters[3] = 0.02
    _, jacobian = evaluation.places(parameters)
    assert np.allclose(jacobian, slopes(lambda p: evaluation.places(p)[0], parameters), atol=1e-8)


def test_stiff_ends_are_extrapolated_straight(tags):
    """The limb bends between its fittings only; the tag before the tip does not mislead the fit."""
    fine = np.linspace(0.0, tags.length, 2441)
    curvature = np.full_like(fine, 6.0)
    for start, end in tags.stiff:
        curvature[(fine >= start) & (fine < end)] = 0.0
    heading = np.concatenate([[0.0], np.cumsum(curvature[:-1] * np.diff(fine))])
    middle = 0.5 * (heading[1:] + heading[:-1])
    steps = np.diff(fine)[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    shape = Shape(fine, np.vstack([np.zeros(2), np.cumsum(steps, axis=0)]), heading)
    with_stiff = ShapeFitter(tags).fit(seen(tags, shape))
    without = ShapeFitter(dataclasses.replace(tags, stiff=())).fit(seen(tags, shape))
    assert np.hypot(*(with_stiff.tip - shape.points[-1])) < 1e-5
    assert np.hypot(*(without.tip - shape.points[-1])) > 3e-5


def test_without_the_last_tags_the_tip_is_left_open(plain):
    shape = constant_curvature(plain.segment_lengths, [0.4, 0.3])
    fitter = ShapeFitter(plain)
    every = fitter.fit(seen(plain, shape))
    few = fitter.fit(seen(plain, shape)[:3])
    assert np.trace(few.tip_systematic) > 50.0 * np.trace(every.tip_systematic)
    error = few.tip - shape.points[-1]
    assert error @ np.linalg.solve(few.tip_systematic + few.tip_covariance, error) < 9.0
    assert few.tags_used == (0, 1, 2)


def test_errors_shared_by_all_tags_move_the_tip(plain):
    shape = constant_curvature(plain.segment_lengths, [0.4, 0.3])
    fitter = ShapeFitter(plain, FollowerOptions(prior=ShapePrior(1.0, 1.0)))
    common = np.zeros((5, 3, 1))
    common[:, 0, 0] = 1e-3
    alone = fitter.fit(seen(plain, shape))
    shared = fitter.fit(seen(plain, shape), common)
    added = shared.tip_systematic - alone.tip_systematic
    assert np.sqrt(added[0, 0]) == pytest.approx(1e-3, rel=0.02)
    assert abs(added[1, 1]) < 1e-10


@pytest.mark.parametrize("wrong", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("shift", [(0.008, 0.0), (0.0, -0.02)])
def test_a_tag_on_the_wrong_place_is_left_out(tags, wrong, shift):
    shape = constant_curvature(tags.segment_lengths, [0.5, -0.2])
    placed = seen(tags, shape)
    pose = placed[wrong].pose + np.array([*shift, 0.0])
    placed[wrong] = dataclasses.replace(placed[wrong], pose=pose)
    estimate = ShapeFitter(tags).fit(placed)
    assert list(estimate.rejected) == [wrong]
    assert estimate.rejected[wrong] == pytest.approx(np.hypot(*shift), rel=0.4)
    if wrong < 3:
        assert np.hypot(*(estimate.tip - shape.points[-1])) < 5e-4


def test_tags_that_contradict_each_other_give_nothing(tags):
    shape = constant_curvature(tags.segment_lengths, [0.0, 0.0])
    random = np.random.default_rng(5)
    placed = [
        dataclasses.replace(tag, pose=tag.pose + random.normal(0.0, [0.1, 0.1, 1.0]))
        for tag in seen(tags, shape)
    ]
    assert ShapeFitter(tags).fit(placed) is None
    assert ShapeFitter(tags).fit([]) is None


@pytest.mark.parametrize(
    ("last", "stamp", "told"),
    [(0.41, 0.06, True), (0.41, 3.0, False), (0.41, -1.0, False), (0.6, 0.06, False)],
)
def test_a_gap_is_bridged_for_a_few_usual_frames_while_the_tip_is_known(plain, last, stamp, told):
    follower = LimbFollower(plain, FollowerOptions())
    for k, bend in enumerate((0.4, last)):
        shape = constant_curvature(plain.segment_lengths, [bend, bend])
        assert follower.follow(seen(plain, shape), 0.03 * k).estimate is not None
    found = follower.follow([], stamp)
    assert (found.estimate is not None) == found.bridged == told
    assert "no limb tag in the image" in found.reason


def test_a_bridge_grows_unsure_and_is_given_up(plain):
    follower = LimbFollower(plain, FollowerOptions(bridge_frames=3))
    for k, bend in enumerate((0.4, 0.41, 0.42)):
        shape = constant_curvature(plain.segment_lengths, [bend, bend])
        known = follower.follow(seen(plain, shape), 0.03 * k).estimate
    bridged = [follower.follow([], 0.03 * k) for k in range(3, 7)]
    spreads = [
        np.trace(each.tip_covariance) for each in (known, *(b.estimate for b in bridged[:3]))
    ]
    assert np.all(np.diff(spreads) > 0.0)
    assert bridged[2].reason.startswith("bridged 3 frames")
    assert np.hypot(*(bridged[0].estimate.tip - shape.points[-1])) < 0.01
    assert bridged[3].estimate is None
    assert follower.follow(seen(plain, shape), 0.3).estimate is not None


def test_what_cannot_be_the_limb_of_the_map_is_refused_with_the_remedy(plain):
    placed = seen(plain, constant_curvature(plain.segment_lengths, [0.1, 0.2]))
    small = [dataclasses.replace(tag, pose=tag.pose * [1e-3, 1e-3, 1.0]) for tag in placed]
    for tags, unfit, said in (
        (small, 0, "0.00 of the map's length: check its units"),
        ([], 5, r"5 limb tag\(s\) do not fit the map: check size and height"),
    ):
        found = LimbFollower(plain, FollowerOptions()).follow(tags, 0.0, unfit=unfit)
        assert found.estimate is None
        assert re.search(said, found.reason)
    alone = dataclasses.replace(plain, limb=plain.limb[:1])
    found = LimbFollower(alone, FollowerOptions()).follow(placed[:1], 0.0)
    assert re.fullmatch(r"the tip is known to \d+ mm only", found.reason)


CLAMP = np.array([0.006, -0.004, 0.05])


@pytest.fixture
def places(tags, swing):
    """Noisy places of the tags of a limb whose clamp is beside `limb_base`, (K, n, 3)."""
    random = np.random.default_rng(6)
    cosine, sine = np.cos(CLAMP[2]), np.sin(CLAMP[2])
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    found = [
        [turn @ swing.shape(time).at(tag.arc_length) + CLAMP for tag in tags.limb]
        for time in np.arange(0.0, 6.0, 0.1)
    ]
    return np.array(found) + random.standard_normal((60, len(tags.limb), 3)) * [1e-4, 1e-4, 2e-3]


def test_the_clamp_is_found_with_its_deviation(tags, plain, places):
    places[3, 2] = np.nan
    clamp = find_clamp(plain, places)
    assert abs(clamp.place[2] - CLAMP[2]) < 0.01
    assert np.abs(clamp.place[:2] - CLAMP[:2]).max() < 6e-4
    assert (clamp.sigma < [1e-3, 1e-3, 0.03]).all()
    places[:, 1:] = np.nan
    assert find_clamp(tags, places) is None


def test_maps_are_written_with_their_base_at_the_clamp(config, tags):
    """What is fixed stays where it is in the room."""
    clamp = Clamp(CLAMP, np.zeros(3))
    turn = Rotation.from_euler("z", -CLAMP[2])

    def expected(points):
        return turn.apply(points - [*CLAMP[:2], 0.0])

    moved = TagMap.from_dict(at_clamp(yaml.safe_load((config / "tags.yaml").read_text()), clamp))
    for old, new in zip(tags.world, moved.world, strict=True):
        np.testing.assert_allclose(new.corners(), expected(old.corners()), atol=1e-12)
    assert moved.limb == tags.limb

    content = yaml.safe_load((config / "bodies.yaml").read_text())
    content["frame"] = {"position": [0.4, -0.2, 0.9], "rotation": [0.1, 0.7, 0.1, 0.7]}
    old, new = BodyMap.from_dict(content), BodyMap.from_dict(at_clamp(content, clamp))
    for before, after in zip(old.fixed, new.fixed, strict=True):
        np.testing.assert_allclose(after.position, expected(before.position), atol=1e-12)
    np.testing.assert_allclose(new.fixed[0].rotation, turn.as_matrix(), atol=1e-12)
    room = np.array([[0.3, 0.1, 0.2], [-1.0, 0.5, 0.0]])
    np.testing.assert_allclose(new.frame.of(room), expected(old.frame.of(room)), atol=1e-12)
