from __future__ import annotations

import numpy as np
import pytest

from apriltag_tracker.camera import CameraPose
from apriltag_tracker.detection.tracking import TagTracker, TrackingOptions
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera

PERIOD = 1.0 / 30.0


def cover(corners, grow=6.0):
    low, high = corners.min(axis=0) - grow, corners.max(axis=0) + grow
    return [low, (high[0], low[1]), high, (low[0], high[1])]


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
    assert tracker.counts.tracked > 0.9 * 40 * len(tags.ids)


def test_a_tag_that_was_covered_comes_back_by_its_region(tags, camera, detector, swing):
    options = TrackingOptions(
        full_search_period=100.0, missing_search_period=100.0, absent_search_period=100.0
    )
    tracker = TagTracker(tags.ids, detector, options)
    for k in range(12):
        time = k * PERIOD
        corners = camera.frame(swing.shape(time)).corners[4]
        covers = [cover(corners)] if 5 <= k < 8 else []
        frame = camera.frame(swing.shape(time), covers=covers)
        ids = {tag.id for tag in tracker.track(frame.image, time)}
        assert (4 in ids) == (not covers)
    assert tracker.counts.full_searches == 1
    assert tracker.counts.by_region >= 1


def test_a_tag_that_was_lost_for_long_comes_back_by_a_full_search(tags, camera, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    corners = camera.frame(swing.shape(0.2)).corners[2]
    for k in range(40):
        covers = [cover(corners)] if k < 25 else []
        frame = camera.frame(swing.shape(0.2), covers=covers)
        ids = {tag.id for tag in tracker.track(frame.image, k * PERIOD)}
    assert 2 in ids
    assert tracker.counts.by_full >= len(tags.ids)


def test_smeared_tags_are_found_in_sharpened_regions(tags, model, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    sharp = SyntheticCamera(model, tags, Optics(exposure=0.0))
    tracker.track(sharp.frame(swing.shape(0.0)).image, 0.0)
    soft = SyntheticCamera(model, tags, Optics(blur=1.9))
    found = 0
    for k in range(1, 6):
        frame = soft.frame(swing.shape(k * PERIOD))
        found += len(tracker.track(frame.image, k * PERIOD))
    assert found > 4 * len(tags.ids)


def test_a_jump_is_followed(tags, camera, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    for k in range(10):
        shape = swing.shape(0.1) if k < 5 else swing.shape(0.8)
        frame = camera.frame(shape)
        found = {tag.id: tag for tag in tracker.track(frame.image, k * PERIOD)}
    assert found.keys() == frame.corners.keys()
    for tag_id, tag in found.items():
        assert np.abs(tag.corners - frame.corners[tag_id]).max() < 0.2


def still_tracker(tags, detector, after=4, **more):
    options = TrackingOptions(still_after=after, **more)
    return TagTracker(tags.ids, detector, options, [tag.id for tag in tags.world])


def test_fixed_tags_are_fitted_in_turn_once_they_are_known(tags, camera, detector, swing):
    tracker = still_tracker(tags, detector)
    fixed = {tag.id for tag in tags.world}
    turns = []
    for k in range(20):
        frame = camera.frame(swing.shape(k * PERIOD), swing.velocity(k * PERIOD))
        found = {tag.id: tag for tag in tracker.track(frame.image, k * PERIOD)}
        assert found.keys() == frame.corners.keys()
        assert all(found[tag.id].measured for tag in tags.limb)
        turns.append({tag for tag in fixed if found[tag].measured})
        assert all(np.abs(found[tag].corners - frame.corners[tag]).max() < 0.1 for tag in fixed)
    assert all(turn == fixed for turn in turns[:4])
    assert all(len(turn) == 1 for turn in turns[8:])
    assert set.union(*turns[-len(fixed) :]) == fixed


def test_a_camera_that_is_pushed_has_all_tags_fitted_at_once(tags, model, detector, swing):
    pushed = CameraModel(
        model.intrinsics,
        CameraPose.looking_down((0.1284, 0.004, 0.600), -1.5650, (0.030, -0.020)),
    )
    cameras = [SyntheticCamera(each, tags, Optics(), seed=3) for each in (model, pushed)]
    tracker = still_tracker(tags, detector)
    for k in range(14):
        frame = cameras[k >= 10].frame(swing.shape(0.3))
        found = {tag.id: tag for tag in tracker.track(frame.image, k * PERIOD)}
        assert found.keys() == frame.corners.keys()
        for tag in found.values():
            assert np.abs(tag.corners - frame.corners[tag.id]).max() < 0.1
        if k >= 10:
            assert all(tag.measured for tag in found.values())


def test_a_fixed_tag_that_is_covered_is_not_taken_for_still(tags, camera, detector, swing):
    tracker = still_tracker(tags, detector)
    for k in range(14):
        corners = camera.frame(None).corners[102]
        covers = [cover(corners)] if k >= 10 else []
        frame = camera.frame(swing.shape(0.3), covers=covers)
        found = {tag.id for tag in tracker.track(frame.image, k * PERIOD)}
        assert (102 in found) == (k < 10)


def test_a_search_that_can_wait_is_left_for_later(tags, camera, detector, swing):
    tracker = still_tracker(tags, detector, full_search_period=0.0)
    frame = camera.frame(swing.shape(0.1))
    copied = paste(frame.image.copy(), frame.corners[1], (900, 500))
    for k, image in enumerate((frame.image, frame.image, copied)):
        searches = tracker.counts.full_searches
        assert len(tracker.track(image, k * PERIOD, search_later=True)) == len(tags.ids)
        # Nothing is known before the first picture: that search cannot wait.
        assert tracker.counts.full_searches - searches == (k == 0)
        tracker.search_again(image)
        assert tracker.counts.full_searches - searches == 1
        tracker.search_again(image)
        assert tracker.counts.full_searches - searches == 1
    assert tracker.counts.duplicates == 1


def paste(image, corners, place):
    """Copy a tag with its margin to another place of the image."""
    low = np.floor(corners.min(axis=0)).astype(int) - 6
    high = np.ceil(corners.max(axis=0)).astype(int) + 7
    piece = image[low[1] : high[1], low[0] : high[0]]
    image[place[1] : place[1] + piece.shape[0], place[0] : place[0] + piece.shape[1]] = piece
    return image


def test_a_duplicate_is_rejected(tags, camera, detector, swing):
    shape = swing.shape(0.1)
    tracker = TagTracker(tags.ids, detector, TrackingOptions(full_search_period=0.0))
    frame = camera.frame(shape)
    tracker.track(frame.image, 0.0)
    copied = paste(frame.image.copy(), frame.corners[1], (900, 500))
    found = {tag.id: tag for tag in tracker.track(copied, PERIOD)}
    assert np.abs(found[1].corners - frame.corners[1]).max() < 0.2
    assert tracker.counts.duplicates == 1

    unseen = TagTracker(tags.ids, detector)
    assert 1 not in {tag.id for tag in unseen.track(copied, 0.0)}
    assert unseen.counts.duplicates == 1


def test_tags_that_are_in_no_map_are_counted(tags, camera, detector, swing):
    tracker = TagTracker([tag for tag in tags.ids if tag != 3], detector)
    found = tracker.track(camera.frame(swing.shape(0.0)).image, 0.0)
    assert 3 not in {tag.id for tag in found}
    assert tracker.counts.unknown == {3: 1}


def test_time_that_goes_back_starts_anew(tags, camera, detector, swing):
    tracker = TagTracker(tags.ids, detector)
    frame = camera.frame(swing.shape(0.0))
    for time in (10.0, 10.0 + PERIOD, 3.0):
        assert len(tracker.track(frame.image, time)) == len(tags.ids)
    assert tracker.counts.full_searches == 2


@pytest.mark.parametrize("level", [0, 255])
def test_nothing_is_tracked_on_a_blank_image(tags, camera, detector, swing, level):
    tracker = TagTracker(tags.ids, detector)
    frame = camera.frame(swing.shape(0.0))
    tracker.track(frame.image, 0.0)
    blank = np.full_like(frame.image, level)
    for k in range(1, 12):
        assert tracker.track(blank, k * PERIOD) == []
