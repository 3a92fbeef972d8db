"""Tags found in pictures by brute force, which share no formula with the detector, and followed."""

from __future__ import annotations

import cv2
import numpy as np
import pyapriltags
import pytest

from apriltag_tracker.detection import Detector, Tag
from apriltag_tracker.detection.tracking import TagTracker, Track
from apriltag_tracker.family import FAMILIES
from benchmarks.tracker.renderer import Scene, render

EACH = pytest.mark.parametrize("each", FAMILIES.values(), ids=FAMILIES)


@pytest.fixture(scope="module")
def picture():
    return render(Scene("large", pixels=34.0), 3, (320, 240))


def check(scene, limit, seeds=(70,)):
    """All tags are found, no other ones, with corners as good as the limit and as their NEES."""
    gaps, nees, asked = [], [], 0
    for seed in seeds:
        image, truth = render(scene, seed, (320, 240))
        asked += len(truth)
        for tag in Detector(family=scene.family).detect(image):
            gap = (tag.corners - truth[tag.id]).ravel()
            gaps.append(gap)
            nees.append(gap @ np.linalg.solve(tag.covariance, gap) / 8.0)
    assert len(gaps) == asked
    assert np.sqrt(np.mean(np.square(gaps))) < limit
    assert np.abs(np.mean(np.reshape(gaps, (-1, 2)), axis=0)).max() < 0.02
    assert 0.25 < np.mean(nees) < 3.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "limit"),
    [
        (Scene("sharp"), 0.03),
        (Scene("small", pixels=20.0), 0.06),
        (Scene("large", pixels=45.0), 0.02),
        (Scene("blur", blur=1.5), 0.2),
        (Scene("defocus", defocus=2.0), 0.1),
        (Scene("noise", noise=12.0), 0.1),
        (Scene("dark", contrast=0.12), 0.13),
        (Scene("smear", smear=4.0), 0.1),
    ],
    ids=lambda value: value.name if isinstance(value, Scene) else None,
)
def test_corners_and_their_covariance_are_honest(scene, limit):
    check(scene, limit, seeds=(40, 41))


@pytest.mark.slow
@EACH
def test_tags_of_every_family_are_found(each):
    # Of the same paper the outer ring takes a part.
    pixels = 30.0 * (0.7 if each.outer_ring else 1.0)
    check(Scene("smear", smear=2.0, family=each, pixels=pixels), 0.06)


@EACH
def test_no_tag_is_found_where_there_is_none(each):
    tags, random = Detector(family=each), np.random.default_rng(17)
    for k in range(12):
        coarse = random.integers(0, 256, random.integers(8, 200, 2), dtype=np.uint8)
        kinds = (cv2.INTER_NEAREST, cv2.INTER_CUBIC, cv2.INTER_LINEAR)
        image = cv2.resize(coarse, (640, 480), interpolation=kinds[k % 3])
        assert tags.detect(image) == []
    for level in (0, 128, 255):
        assert tags.detect(np.full((240, 320), level, np.uint8)) == []


@pytest.mark.parametrize("name", ["tag36h11", "tag16h5", "tag25h9", "tagStandard41h12"])
def test_the_c_library_reads_the_same_tags_the_same_way_round(name):
    pixels = 48.0 if not FAMILIES[name].outer_ring else 34.0
    image, truth = render(Scene("large", pixels=pixels, family=FAMILIES[name]), 71, (320, 240))
    theirs = pyapriltags.Detector(families=name).detect(image)
    # The C library counts pixels from their corners, we from their centres.
    seen = {tag.tag_id: np.asarray(tag.corners) - 0.5 for tag in theirs if tag.decision_margin > 50}
    assert seen.keys() >= truth.keys()
    assert all(np.abs(seen[tag] - corners).max() < 0.5 for tag, corners in truth.items())


def test_a_mirror_image_shows_no_tags(picture):
    image, truth = picture
    assert len(Detector().detect(image)) == len(truth)
    assert Detector().detect(np.ascontiguousarray(image[:, ::-1])) == []


def test_tags_with_a_corner_covered_are_not_elsewhere():
    image, truth = render(Scene("covered", corner=0.25), 40)
    found = Detector().detect(image)
    assert len(found) > 0.4 * len(truth)
    assert all(np.abs(tag.corners - truth[tag.id]).max() < 0.5 for tag in found)


def test_a_tag_is_confirmed_only_where_it_is_and_by_its_own_code(picture):
    image, truth = picture
    ids, corners = list(truth), np.array(list(truth.values()))
    tags = Detector()
    assert [tag.id for tag in tags.confirm(image, ids, corners + 1.5)] == ids
    assert tags.confirm(image, ids, corners + 12.0) == []
    assert tags.confirm(image, [tag + 1 for tag in ids], corners) == []


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (np.zeros((5, 5)), "uint8"),
        (None, "uint8"),
        (np.zeros((0, 640), np.uint8), "empty"),
    ],
)
def test_what_is_no_image_is_refused(image, reason):
    with pytest.raises(ValueError, match=reason):
        Detector().detect(image)


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
