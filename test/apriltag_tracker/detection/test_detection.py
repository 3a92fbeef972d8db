"""Tags found in pictures by brute force, which share no formula with the detector."""

from __future__ import annotations

import cv2
import numpy as np
import pyapriltags
import pytest

from apriltag_tracker.detection import Detector
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
