from __future__ import annotations

import numpy as np

from apriltag_tracker.detection import Tag
from apriltag_tracker.detection.tracking import TagTracker, Track

PERIOD = 1.0 / 30.0
SQUARE = np.array([[100.0, 140.0], [140.0, 140.0], [140.0, 100.0], [100.0, 100.0]])


def follow(places, times) -> Track:
    """Return the track of a square that was at these places at these times."""
    seen = [Tag(3, SQUARE + place, np.eye(8) * 1e-4, 0.02) for place in places]
    track = Track(seen[0], times[0])
    for tag, time in zip(seen[1:], times[1:], strict=True):
        track = track.follow(tag, time)
    return track


def test_a_parabola_is_foreseen_whatever_the_gaps():
    times = np.array([0.0, 0.03, 0.07, 0.1])
    places = [np.array([3.0 + 200.0 * t + 900.0 * t * t, -150.0 * t]) for t in times]
    track = follow(places[:3], times[:3])
    assert np.allclose(track.predict(times[3]), SQUARE + places[3])


def test_a_moving_limb_is_tracked_as_well_as_it_is_detected(tags, camera, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    tracked, searched = [], []
    for k in range(40):
        time = k * PERIOD
        frame = camera.frame(swing.shape(time), swing.velocity(time))
        found = {tag.id: tag for tag in tracker.track(frame.image, time)}
        assert found.keys() == frame.corners.keys()
        for tag in detector.detect(frame.image):
            searched.append(tag.corners - frame.corners[tag.id])
            tracked.append(found[tag.id].corners - frame.corners[tag.id])
    assert np.sqrt(np.mean(np.square(tracked))) < 1.1 * np.sqrt(np.mean(np.square(searched)))
    assert tracker.counts.full_searches <= 3


def test_a_tag_that_was_lost_for_long_comes_back_by_a_full_search(tags, camera, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    x, y = camera.frame(swing.shape(0.2)).corners[2].mean(axis=0).astype(int)
    for k in range(40):
        image = camera.frame(swing.shape(0.2)).image
        if k < 25:
            image[y - 30 : y + 30, x - 30 : x + 30] = 70
        ids = {tag.id for tag in tracker.track(image, k * PERIOD)}
        assert 2 not in ids or k >= 25
    assert 2 in ids


def test_a_jump_is_followed(tags, camera, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    for k in range(10):
        shape = swing.shape(0.1) if k < 5 else swing.shape(0.8)
        frame = camera.frame(shape)
        found = {tag.id: tag for tag in tracker.track(frame.image, k * PERIOD)}
    assert found.keys() == frame.corners.keys()
    for tag_id, tag in found.items():
        assert np.abs(tag.corners - frame.corners[tag_id]).max() < 0.2


def paste(image, corners, place):
    """Copy a tag with its margin to another place of the image."""
    low = np.floor(corners.min(axis=0)).astype(int) - 6
    high = np.ceil(corners.max(axis=0)).astype(int) + 7
    piece = image[low[1] : high[1], low[0] : high[0]]
    image[place[1] : place[1] + piece.shape[0], place[0] : place[0] + piece.shape[1]] = piece
    return image


def test_a_tag_seen_twice_before_it_was_tracked_is_left_out(tags, camera, detector, swing):
    frame = camera.frame(swing.shape(0.1))
    copied = paste(frame.image.copy(), frame.corners[1], (900, 500))
    tracker = TagTracker(tags.ids, detector)
    assert 1 not in {tag.id for tag in tracker.track(copied, 0.0)}
    assert tracker.counts.duplicates == 1


def test_tags_that_are_in_no_map_are_counted(tags, camera, detector, swing):
    tracker = TagTracker([tag for tag in tags.ids if tag != 3], detector)
    found = tracker.track(camera.frame(swing.shape(0.0)).image, 0.0)
    assert 3 not in {tag.id for tag in found}
    assert tracker.counts.unknown == {3: 1}


def test_time_that_goes_back_starts_anew_and_a_blank_image_shows_nothing(
    tags, camera, detector, swing
):
    tracker = TagTracker(tags.ids, detector)
    image = camera.frame(swing.shape(0.0)).image
    for time in (10.0, 10.0 + PERIOD, 3.0):
        assert len(tracker.track(image, time)) == len(tags.ids)
    assert tracker.counts.full_searches == 2
    assert tracker.track(np.zeros_like(image), 3.0 + PERIOD) == []
