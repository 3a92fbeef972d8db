"""The clamp is found from the limb where the map has it elsewhere."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from apriltag_tracker.pose.clamp import find_clamp

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
    arcs = np.array([tag.arc_length for tag in tags.limb])
    offsets = [tag.offset for tag in tags.limb]
    places[3, 2] = np.nan
    clamp = find_clamp(dataclasses.replace(tags, stiff=()), arcs, offsets, places)
    assert abs(clamp.place[2] - CLAMP[2]) < 0.01
    assert np.abs(clamp.place[:2] - CLAMP[:2]).max() < 6e-4
    assert (clamp.sigma < [1e-3, 1e-3, 0.03]).all()
    places[:, 1:] = np.nan
    assert find_clamp(tags, arcs, offsets, places) is None
