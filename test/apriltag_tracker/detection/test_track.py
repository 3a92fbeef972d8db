from __future__ import annotations

import numpy as np
import pytest

from apriltag_tracker.detection.still import look_at_borders, unmoved
from apriltag_tracker.detection.tag import Tag
from apriltag_tracker.detection.track import Track
from apriltag_tracker.synthetic.camera import Optics, SyntheticCamera

SQUARE = np.array([[100.0, 140.0], [140.0, 140.0], [140.0, 100.0], [100.0, 100.0]])


def seen(corners) -> Tag:
    return Tag(3, corners, np.eye(8) * 1e-4, 0.02, 1.0, 150.0)


def follow(places, times) -> Track:
    track = Track(seen(SQUARE + places[0]), times[0])
    for place, time in zip(places[1:], times[1:], strict=True):
        track = track.follow(seen(SQUARE + place), time)
    return track


def test_a_parabola_is_foreseen_whatever_the_gaps():
    times = np.array([0.0, 0.03, 0.07, 0.1])
    places = [np.array([3.0 + 200.0 * t + 900.0 * t * t, -150.0 * t]) for t in times]
    track = follow(places[:3], times[:3])
    assert np.allclose(track.predict(times[3]), SQUARE + places[3])
    assert not Track(seen(SQUARE), 0.0).foreseen(8)
    assert follow(places, times).foreseen(8)


def test_what_goes_to_and_fro_is_foreseen_without_its_acceleration():
    times = np.arange(6) / 30.0
    track = follow([np.array([2.0 * (k % 2), 0.0]) for k in range(6)], times)
    assert np.abs(track.predict(0.2) - track.tag.corners).max() == pytest.approx(2.0)
    assert not track.foreseen(8)


def test_lines_come_first_for_a_while_where_the_pattern_did_not_fit():
    times = np.arange(30) / 30.0
    track = follow([np.zeros(2)] * 2, times[:2])
    track.avoid_pattern()
    waited = 0
    for time in times[2:]:
        track = track.follow(seen(SQUARE), time)
        waited += not track.foreseen(8)
    assert 5 < waited < 20


@pytest.mark.parametrize("shift", [(0.1, -0.05), (0.35, 0.0), (0.0, -2.5)])
def test_a_look_at_the_border_says_how_far_it_went(tags, model, shift):
    frame = SyntheticCamera(model, tags, Optics(), seed=4).frame(None)
    corners = np.array([frame.corners[tag.id] for tag in tags.world])
    there, moved = np.empty((2, len(corners), 4, 2))
    look_at_borders(frame.image, corners, 8, there)
    look_at_borders(frame.image, corners - shift, 8, moved)
    assert np.abs(there[:, :, 0]).max() < 0.06
    # Sides know what goes across them.
    out = corners + np.roll(corners, -1, axis=1) - 2.0 * corners.mean(axis=1, keepdims=True)
    out /= np.linalg.norm(out, axis=2, keepdims=True)
    if np.hypot(*shift) < 0.5:
        assert np.allclose(moved[:, :, 0], out @ shift, atol=0.15)
    assert np.all(unmoved(there, there))
    assert np.all(unmoved(moved, there)) == (np.hypot(*shift) < 0.2)


def test_a_side_that_is_covered_or_out_of_the_picture_is_not_the_same(tags, model):
    frame = SyntheticCamera(model, tags, Optics(), seed=4).frame(None)
    corners = np.array([frame.corners[tag.id] for tag in tags.world])
    before, after = np.empty((2, len(corners), 4, 2))
    look_at_borders(frame.image, corners, 8, before)
    x, y = corners[0, 1].astype(int)
    frame.image[y - 24 : y + 25, x - 24 : x + 25] = 90
    look_at_borders(frame.image, corners, 8, after)
    same = unmoved(after, before)
    assert not same[0]
    assert same[1:].all()
    corners[1] += (model.intrinsics.width - corners[1].max(axis=0)[0], 0.0)
    look_at_borders(frame.image, corners, 8, after)
    assert not unmoved(after, before)[1]
