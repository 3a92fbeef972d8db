from __future__ import annotations

import cv2
import numpy as np
import pytest

from apriltag_tracker.camera import CameraError
from apriltag_tracker.synthetic.camera import (
    CameraModel,
    Optics,
    Shape,
    SyntheticCamera,
)
from apriltag_tracker.synthetic.shapes import constant_curvature
from benchmarks.tracker.renderer import BLACK, FULL, WHITE, Scene, draw_patch


@pytest.mark.parametrize("blur", [0.5, 1.2])
def test_pixels_agree_with_brute_force_sampling(model, tags, blur):
    optics = Optics(noise=0.0, light_fall=0.0, blur=blur, black=FULL * BLACK, white=FULL * WHITE)
    shape = constant_curvature(tags.segment_lengths, [0.5, 0.4])
    frame = SyntheticCamera(model, tags, optics).frame(shape)
    corners = frame.corners[2]
    left, top = np.floor(corners.mean(axis=0)).astype(int) - 32
    drawn = FULL * draw_patch(Scene("", blur=blur), 2, corners - (left, top), 64)
    # The tag's own square: outside of it the limb's body is drawn in another way.
    mask = np.zeros((64, 64), dtype=np.uint8)
    cv2.fillConvexPoly(mask, np.round(corners - (left, top)).astype(np.int32), 1)
    gap = (frame.image[top : top + 64, left : left + 64] - drawn)[mask > 0]
    assert np.abs(gap).max() < 6.0
    assert np.sqrt(np.mean(gap**2)) < 1.2
    assert abs(gap.mean()) < 0.3


def test_pictures_repeat_with_their_seed(model, tags):
    shape = constant_curvature(tags.segment_lengths, [0.2, 0.1])
    first, second, other = (SyntheticCamera(model, tags, seed=seed) for seed in (5, 5, 6))
    picture = first.frame(shape).image
    assert np.array_equal(picture, second.frame(shape).image)
    assert not np.array_equal(picture, other.frame(shape).image)
    assert not np.array_equal(picture, first.frame(shape).image)


@pytest.mark.slow
def test_motion_blur_is_the_mean_of_sharp_pictures(model, tags):
    shape = constant_curvature(tags.segment_lengths, [0.3, 0.3])
    still = np.zeros_like(shape.heading)
    motion = np.tile([0.0, 0.6], (len(still), 1))
    optics = Optics(noise=0.0, exposure=0.01)
    blurred = SyntheticCamera(model, tags, optics).frame(
        shape, Shape(shape.arc_length, motion, still)
    )
    camera = SyntheticCamera(model, tags, Optics(noise=0.0, exposure=0.0))
    sharp = []
    for share in (np.arange(21) + 0.5) / 21 - 0.5:
        moved = Shape(shape.arc_length, shape.points + share * 0.01 * motion, shape.heading)
        sharp.append(camera.frame(moved).image.astype(float))
    mean = np.mean(sharp, axis=0)
    corners = blurred.corners[3]
    mask = np.zeros(mean.shape, dtype=np.uint8)
    middle = corners.mean(axis=0)
    cv2.fillConvexPoly(mask, np.round(middle + 0.7 * (corners - middle)).astype(np.int32), 1)
    gap = (blurred.image - mean)[mask > 0]
    still_gap = (camera.frame(shape).image - mean)[mask > 0]
    assert np.sqrt(np.mean(gap**2)) < 0.03 * np.sqrt(np.mean(still_gap**2))


def test_shapes_are_interpolated_and_continued(tags):
    shape = constant_curvature(tags.segment_lengths, [0.6, -0.4], points=9)
    exact = constant_curvature(tags.segment_lengths, [0.6, -0.4], points=1001)
    for arc_length in (0.03, 0.13, 0.2, 0.244):
        k = int(np.argmin(np.abs(exact.arc_length - arc_length)))
        s = exact.arc_length[k]
        place = shape.at(s)
        assert np.allclose(place[:2], exact.points[k], atol=3e-6)
        assert place[2] == pytest.approx(exact.heading[k], abs=1e-9)
    beyond = shape.at(0.254)
    end, angle = exact.points[-1], exact.heading[-1]
    assert np.allclose(beyond[:2], end + 0.01 * np.array([np.cos(angle), np.sin(angle)]))


def test_a_wrong_camera_file_is_named(tmp_path):
    path = tmp_path / "camera.yaml"
    path.write_text("schema: 1\nwidth: 10\n")
    with pytest.raises(CameraError, match=r"camera\.yaml"):
        CameraModel.from_yaml(path)
    path.write_text("schema: 7\n")
    with pytest.raises(CameraError, match="schema"):
        CameraModel.from_yaml(path)
