from __future__ import annotations

import cv2
import numpy as np
import pytest

from apriltag_tracker import family
from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.detection import Detector
from apriltag_tracker.detection import detector as detection
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.tag_map import LimbTag, TagMap, WorldTag

pytestmark = pytest.mark.slow

pyapriltags = pytest.importorskip("pyapriltags")


def board(size_px: float, optics: Optics, seed: int = 0, count: int = 24) -> SyntheticCamera:
    """A camera of 640 x 480 px over tags in all directions, `size_px` large."""
    random = np.random.default_rng(seed)
    size, height, f = 0.02, 0.5, size_px / 0.02 * 0.5
    pitch = 2.0 * size
    world = []
    for k in range(count):
        x = (k % 6 - 2.5) * pitch + random.uniform(-0.002, 0.002)
        y = (k // 6 - 1.5) * pitch + random.uniform(-0.002, 0.002)
        world.append(WorldTag(k, (x, y, 0.0), float(random.uniform(-np.pi, np.pi)), size))
    tags = TagMap((0.1,), (LimbTag(500, 0.05, 0.0, size),), tuple(world))
    matrix = [f, 0.0, 320.2, 0.0, f, 239.4, 0.0, 0.0, 1.0]
    lens = Intrinsics.create(640, 480, matrix, [-0.1, 0.05, 0.0, 0.0])
    pose = CameraPose.looking_down((0.0, 0.0, height), 0.2, (0.05, -0.08))
    return SyntheticCamera(CameraModel(lens, pose), tags, optics, seed=seed)


def corner_errors(camera: SyntheticCamera, detector: Detector, frames: int = 2):
    """Return corner errors (n, 4, 2) px and how many tags were missed."""
    errors, missed = [], 0
    for _ in range(frames):
        frame = camera.frame(None)
        found = {tag.id: tag for tag in detector.detect(frame.image)}
        for tag, corners in frame.corners.items():
            if corners.min() < 10 or (corners.max(axis=0) > (629, 469)).any():
                continue
            if tag in found:
                errors.append(found[tag].corners - corners)
            else:
                missed += 1
    return np.array(errors), missed


def test_another_corner_order_is_noticed(monkeypatch):
    monkeypatch.setattr(detection, "_CHECKED", set())
    monkeypatch.setattr(detection, "_FROM_OPENCV", (0, 1, 2, 3))
    with pytest.raises(family.FamilyError, match="conventions"):
        Detector()


@pytest.mark.parametrize(
    ("size", "blur", "noise", "limit"),
    [(30.0, 0.6, 2.0, 0.05), (30.0, 0.9, 4.0, 0.07), (40.0, 0.6, 2.0, 0.03), (20.0, 0.5, 2.0, 0.1)],
)
def test_all_tags_are_found_with_subpixel_corners(detector, size, blur, noise, limit):
    camera = board(size, Optics(blur=blur, noise=noise))
    errors, missed = corner_errors(camera, detector)
    assert missed == 0
    assert len(errors) >= 24
    assert np.sqrt(np.mean(errors**2)) < limit
    assert np.abs(errors.mean(axis=(0, 1))).max() < 0.02


def test_the_corner_covariance_says_how_far_corners_scatter(detector):
    camera = board(32.0, Optics(noise=5.0, blur=0.6))
    samples: dict[int, list] = {}
    claimed: dict[int, list] = {}
    for _ in range(16):
        frame = camera.frame(None)
        for tag in detector.detect(frame.image):
            samples.setdefault(tag.id, []).append(tag.corners.ravel())
            claimed.setdefault(tag.id, []).append(np.diag(tag.covariance))
    seen = np.mean([np.var(samples[tag], axis=0, ddof=1) for tag in samples])
    said = np.mean([np.mean(claimed[tag], axis=0) for tag in samples])
    assert 0.5 < said / seen < 4.0


def test_corners_start_at_the_printed_lower_left_like_the_c_library(detector):
    camera = board(34.0, Optics())
    image = camera.frame(None).image
    ours = {tag.id: tag for tag in detector.detect(image)}
    theirs = pyapriltags.Detector(families="tag36h11").detect(image)
    assert len(theirs) > 20
    for tag in theirs:
        # The C library counts pixels from their corners, we from their centres.
        assert np.abs(ours[tag.tag_id].corners - (tag.corners - 0.5)).max() < 0.6


def test_a_mirror_image_shows_no_tags(detector):
    image = board(34.0, Optics()).frame(None).image
    assert len(detector.detect(image)) == 24
    assert detector.detect(np.ascontiguousarray(image[:, ::-1])) == []


def test_no_tag_is_found_where_there_is_none(detector):
    random = np.random.default_rng(0)
    for k in range(30):
        coarse = random.integers(0, 256, (48 + k, 64 + k), dtype=np.uint8)
        kinds = (cv2.INTER_NEAREST, cv2.INTER_CUBIC, cv2.INTER_LINEAR)
        image = cv2.resize(coarse, (640, 480), interpolation=kinds[k % 3])
        assert detector.detect(image) == []


def test_centre_is_where_the_diagonals_cross(detector):
    for tag in detector.detect(board(30.0, Optics()).frame(None).image)[:3]:
        a, b, c, d = tag.corners
        for first, last in ((a, c), (b, d)):
            along = last - first
            gap = tag.centre - first
            assert abs(along[0] * gap[1] - along[1] * gap[0]) / np.hypot(*along) < 1e-9


@pytest.mark.parametrize(
    "image", [np.zeros((5, 5)), np.zeros((5, 5, 2, 2), np.uint8), "no image", None]
)
def test_what_is_no_image_is_refused(detector, image):
    with pytest.raises(ValueError, match="uint8"):
        detector.detect(image)


def test_an_empty_picture_is_refused(detector):
    with pytest.raises(ValueError, match="empty"):
        detector.detect(np.zeros((0, 640), np.uint8))


@pytest.mark.parametrize("bits", [-1, 3])
def test_more_forgiven_cells_than_are_safe_are_refused(bits):
    with pytest.raises(ValueError, match="correct_bits"):
        Detector(correct_bits=bits)


def test_empty_and_saturated_images_have_no_tags(detector):
    for level in (0, 128, 255):
        assert detector.detect(np.full((480, 640), level, np.uint8)) == []
