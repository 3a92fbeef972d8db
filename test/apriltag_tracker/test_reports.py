from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from waiting import Clock

from apriltag_tracker.camera import project
from apriltag_tracker.pipeline import LimbObservation, LimbTracker
from apriltag_tracker.reports import ImageWatch, draw_observation


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def tracker(tags, model):
    return LimbTracker(tags, model.intrinsics)


def test_silence_is_stale_and_names_the_remedy(clock):
    watch = ImageWatch("/limb/camera/image_raw", True, clock)
    level, message = watch.report(None)
    assert level == "stale"
    assert "/limb/camera/image_raw" in message
    assert "start the camera" in message
    clock.now += 5.0
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" in watch.report(None, publishers=1)[1]


def test_images_without_calibration_are_an_error(clock):
    watch = ImageWatch("topic", True, clock)
    watch.arrived(0)
    level, message = watch.report(None)
    assert level == "error"
    assert "calibrate_camera" in message
    watch.calibration_problem = "the camera is not calibrated"
    assert watch.report(None) == ("error", "the camera is not calibrated")
    watch = ImageWatch("/dev/video0", False, clock)
    watch.image_problem = "the camera /dev/video0 gives no images: was it unplugged?"
    level, message = watch.report(None)
    assert level == "error"
    assert "unplugged" in message


def test_a_stream_that_stops_is_an_error(clock, tracker, camera, swing):
    watch = ImageWatch("topic", True, clock)
    for k in range(5):
        clock.now += 0.1
        watch.arrived(k)
        frame = camera.frame(swing.shape(0.0))
        watch.observed(tracker.observe(frame.image, float(k)), 0.004, 0.002)
    assert watch.report(tracker, 1) == ("ok", "tracking")
    values = watch.tracking_values(tracker)
    assert values["rate_hz"] == "10.0"
    assert values["latency_ms_median"] == "4.00"
    assert values["processing_ms_p99"] == "2.00"
    clock.now += 3.0
    assert watch.report(tracker, 1)[0] == "error"


def test_stamps_that_tell_no_time_are_named(clock, tracker, camera, swing):
    watch, image = ImageWatch("topic", True, clock), camera.frame(swing.shape(0.0)).image
    assert [watch.arrived(stamp) for stamp in (0, 0, 7, 7, 8)] == [True, False, True, False, True]
    assert watch.repeated == 2
    watch.observed(tracker.observe(image, 0.0), 90.0, 0.002)
    level, message = watch.report(tracker)
    assert level == "warning"
    assert "topic are 90 s old: are they of another clock" in message
    for _ in range(20):
        watch.arrived(8)
    level, message = watch.report(tracker)
    assert level == "error"
    assert "no stamps, or all the same" in message


@pytest.mark.parametrize("height", [0.0, 0.06])
def test_limb_tags_that_all_look_too_large_or_small_are_a_warning(
    clock, tags, model, camera, swing, height
):
    limb = tuple(dataclasses.replace(tag, height=height) for tag in tags.limb)
    tracker = LimbTracker(dataclasses.replace(tags, limb=limb), model.intrinsics)
    watch, image = ImageWatch("topic", True, clock), camera.frame(swing.shape(0.0)).image
    for k in range(40):
        watch.arrived(k)
        watch.observed(tracker.observe(image, k / 30.0), 0.004, 0.002)
    level, message = watch.report(tracker)
    assert level == "warning"
    assert re.search("look [45] % larger or smaller than the tag map says: check height", message)


def test_problems_come_before_the_state(clock, tracker):
    watch = ImageWatch("topic", True, clock)
    watch.arrived(0)
    watch.failed_with("unknown encoding")
    assert watch.report(tracker) == ("error", "unknown encoding")
    watch.observed(LimbObservation((), None, "no limb tag in the image"), 0.0, 0.0)
    assert watch.report(tracker) == ("error", "no limb tag in the image")
    assert watch.values()["states_invalid"] == 1
    assert watch.values()["images_failed"] == 1


def test_the_annotated_picture_marks_the_tip(tracker, camera, swing):
    shape = swing.shape(0.2)
    frame = camera.frame(shape)
    observation = tracker.observe(frame.image, 0.0)
    picture = draw_observation(frame.image, observation, tracker)
    assert picture.shape == (*frame.image.shape, 3)
    tip = np.array([[*shape.points[-1], tracker.tags.limb[0].height]])
    x, y = np.round(project(tracker.intrinsics, tracker.world.pose, tip)[0]).astype(int)
    around = picture[y - 9 : y + 10, x - 9 : x + 10].astype(int)
    assert np.ptp(around, axis=2).max() > 60  # colour in a grey picture
    empty = draw_observation(frame.image, LimbObservation((), None, ""), tracker)
    assert np.ptp(empty.astype(int), axis=2).max() == 0
