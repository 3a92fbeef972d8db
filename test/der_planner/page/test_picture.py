"""Pictures are no faster and no larger than asked for, and what lies over them is of their time."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.camera.pinhole import project
from apriltag_tracker.detection import Tag
from apriltag_tracker.tag_map import TagMap
from der_planner.page.picture import LOOKING, Overlay, PictureFeed

TAG_MAP = Path(__file__).parents[3] / "src" / "apriltag_tracker" / "config" / "tags.yaml"


@pytest.mark.parametrize("camera_rate", [30.0, 25.0, 10.0])
def test_pictures_keep_their_rate_while_somebody_looks(camera_rate: float) -> None:
    now = 0.0
    feed = PictureFeed(15.0, clock=lambda: now)
    assert not feed.due()
    assert not feed.has_newer(0)
    taken = 0
    for frame in range(int(camera_rate)):
        now = frame / camera_rate
        taken += feed.due()
    assert min(camera_rate, 15.0) - 3 <= taken <= 16
    now += LOOKING + 0.1
    assert not feed.due()


def test_a_small_window_gets_a_small_file_that_is_made_once() -> None:
    feed = PictureFeed(15.0)
    feed.put(5, np.random.default_rng(0).integers(0, 255, (720, 1280), dtype=np.uint8))
    whole, half = feed.take(), feed.take(shown=700)
    assert half.size == whole.size == (1280, 720)  # what is drawn over it is in the camera's pixels
    shapes = [
        cv2.imdecode(np.frombuffer(one.jpeg, np.uint8), cv2.IMREAD_GRAYSCALE).shape
        for one in (whole, half)
    ]
    assert shapes == [(720, 1280), (360, 640)]
    assert feed.take(shown=640) is half
    assert feed.take(shown=2000) is whole


def test_pixels_become_metres_where_they_are_drawn() -> None:
    tags, now = TagMap.from_yaml(str(TAG_MAP)), 0.0
    overlay = Overlay(tags, clock=lambda: now)
    pixels = np.array([[500.0, 300.0], [700.0, 420.0]])
    assert overlay.on_plane(pixels) is None
    assert overlay.pixels_of(pixels) == []
    camera = Intrinsics.create(
        1280, 720, [1400, 0, 640, 0, 1400, 360, 0, 0, 1], [-0.1, 0.05, 0, 0, 0], "plumb_bob"
    )
    pose = CameraPose.looking_down((0.12, 0.0, 0.8), turn=0.2, tilt=(0.05, -0.03))
    seen = [
        Tag(entry.id, project(camera, pose, entry.corners()), np.eye(8) * 1e-4, 0.01)
        for entry in tags.world
    ]  # fmt: skip
    overlay.put_camera(camera)
    overlay.put_tags(1, seen)
    on_plane = overlay.on_plane(pixels)
    assert on_plane is not None
    height = max(tag.height for tag in tags.limb)
    back = project(camera, pose, np.column_stack([on_plane, np.full(2, height)]))
    np.testing.assert_allclose(back, pixels, atol=0.5)
    np.testing.assert_allclose(overlay.pixels_of(on_plane), pixels, atol=0.2)
    overlay.put_shape("planned", on_plane)
    broken = np.vstack([on_plane, [[math.nan, 0.1], [0.1, math.inf]]])
    overlay.put_shape("estimate", broken)
    shown = overlay.at(1, (math.nan, 0.0))  # what is nowhere is left out: it is no JSON either
    np.testing.assert_allclose(shown["estimate"], pixels, atol=0.2)
    assert shown["reference"] is None
    now = 1.0
    shown = overlay.at(1, None)
    assert (shown["estimate"], shown["planned"]) == ([], [])  # nobody plans or corrects any more

    # A picture that the tracker says nothing of shows neither limb nor tags of an earlier one.
    overlay.put_limb(1, np.vstack([[0.0, 0.0], on_plane[0]]), on_plane[:1])
    near, far = overlay.at(200_000_000, None), overlay.at(2_000_000_000, None)
    np.testing.assert_allclose(near["tip"], pixels[0], atol=0.2)
    assert len(near["tags"]) == len(seen)
    assert (far["tip"], far["curve"], far["tags"]) == (None, [], [])
    assert "tracker" in far["problem"]
