"""The clamp is found from the limb where the map has it elsewhere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.pose.clamp import Clamp, at_clamp, find_clamp
from apriltag_tracker.tag_map import TagMap

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


def test_the_clamp_is_found_with_its_deviation(tags, places):
    places[3, 2] = np.nan
    clamp = find_clamp(dataclasses.replace(tags, stiff=()), places)
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
