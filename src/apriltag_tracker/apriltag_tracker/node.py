"""The node `apriltag_tracker`: images in, tags and the limb's state out."""

from __future__ import annotations

import array
import time
from dataclasses import astuple, replace

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose2D
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from sensor_msgs.msg import CameraInfo, Image

from apriltag_tracker.camera import CameraError, Intrinsics
from apriltag_tracker.camera.images import ImageError, ImageReader, Source, open_source
from apriltag_tracker.detection import SMALLEST_TAG, Detector
from apriltag_tracker.pipeline import LimbObservation, LimbTracker, PlacedTag
from apriltag_tracker.pose.node import LimbStateNode, transform
from apriltag_tracker.pose.shape import FollowerOptions
from apriltag_tracker.reports import NO_CALIBRATION, ImageWatch, draw_observation
from apriltag_tracker.tag_map import TagMap
from der_msgs.msg import TagDetection
from limb_interfaces import qos, stamps, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node

ANNOTATED_IMAGE = "camera/image_annotated"
CAMERA_FRAME = "limb_camera"
"""Name of the frame of a camera that names none: x right, y down, z out of the lens."""


class TrackerNode(LimbStateNode):
    """Follows the limb in images of a topic, a camera, a video file or a folder."""

    def __init__(self) -> None:
        super().__init__("apriltag_tracker", "tag_map", "tags.yaml", "tag")
        calibration = declare(
            self, "calibration_file", "", "camera_info YAML; empty: from the camera_info topic"
        )
        where = "where images come from: topic, /dev/videoN, a video file, or a folder of images"
        source = str(declare(self, "source", "topic", where))
        rate = declare(self, "source_rate", 30.0, "images a second from a folder", 0.1, 500.0)
        cv2.setNumThreads(declare(self, "threads", 1, "threads of OpenCV", 1, 64))
        self._map = TagMap.from_yaml(self.map_path)
        self._options = self._declare_options()
        self._detector = self._make_detector()
        check_overrides(self)
        self._tracker: LimbTracker | None = None
        self._reader = ImageReader()
        self._frame = ""
        self._level = ""
        self._image_topic = self.resolve_topic_name(topics.IMAGE)
        live = source == "topic"
        self._watch = ImageWatch(self._image_topic if live else source, live)
        self.make_outputs(len(self._map.segment_lengths))
        self._annotated = self.create_publisher(Image, ANNOTATED_IMAGE, qos.SENSOR_DATA)
        if calibration:
            self._set_calibration(Intrinsics.from_yaml(str(calibration)))
        self._source: Source | None = None
        if live:
            self._subscribe(needs_info=not calibration)
        else:
            self._source = self._open_source(source, rate)
            self._source_timer = self.create_timer(0.002, self._poll_source)
        self._diagnostics = DiagnosticsPublisher(self, self._health, source)

    def close(self) -> None:
        """Release the camera or file."""
        if self._source is not None:
            self._source.close()

    # Set-up

    def _open_source(self, source: str, rate: float) -> Source:
        """Open a camera, a video file or a folder for images of the calibration's size."""
        if self._tracker is None:
            raise CameraError(
                f"source '{source}' brings no camera_info: set the parameter calibration_file "
                "(scripts/calibrate_camera.py writes one)"
            )
        lens = self._tracker.intrinsics
        return open_source(source, rate, size=(lens.width, lens.height))

    def _declare_options(self) -> FollowerOptions:
        options = self.declare_following(FollowerOptions())
        heights = "of limb tags' heights, m"
        height = declare(self, "height_sigma", options.uncertainty.height, heights, 0.0, 0.1)
        return replace(options, uncertainty=replace(options.uncertainty, height=height))

    def _make_detector(self) -> Detector:
        family = self._map.family
        side = "shortest side of a tag in px"
        shortest = declare(self, "smallest_tag", SMALLEST_TAG, side, 8.0, 500.0)
        forgiven = "wrong bits of a code that are forgiven in a search"
        usual, most = family.correct_bits, family.most_corrected
        bits = declare(self, "correct_bits", usual, forgiven, 0, most)
        return Detector(shortest, bits, family=family)

    def _subscribe(self, needs_info: bool) -> None:
        # A best-effort subscriber hears best-effort and reliable publishers alike.
        self.create_subscription(Image, topics.IMAGE, self._on_image, qos.IMAGES)
        if needs_info:
            # Two, since a latched publisher and a volatile one need different subscribers: the one
            # that asks for the kept message is not matched with a camera that keeps none.
            quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
            kept = CameraInfo, topics.CAMERA_INFO, self._on_info, qos.LATCHED
            self.create_subscription(*kept, event_callbacks=quiet)
            self.create_subscription(CameraInfo, topics.CAMERA_INFO, self._on_info, qos.IMAGES)

    # Input

    def _on_info(self, message: CameraInfo) -> None:
        try:
            intrinsics = Intrinsics.create(
                message.width, message.height, message.k, message.d, message.distortion_model
            )
        except CameraError as error:
            self._watch.calibration_problem = str(error)
            return
        self._set_calibration(intrinsics)

    def _set_calibration(self, intrinsics: Intrinsics) -> None:
        """Take a calibration; one that is like the present one changes nothing."""
        self._watch.calibration_problem = ""
        if self._tracker is not None:
            now = astuple(self._tracker.intrinsics)
            if all(map(np.array_equal, now, astuple(intrinsics))):
                return
        self._tracker = LimbTracker(self._map, intrinsics, self._options, self._detector)

    def _on_image(self, message: Image) -> None:
        self._frame = message.header.frame_id
        try:
            gray = self._reader.to_grey(message)
        except ValueError as error:
            self._watch.arrived(stamps.nanoseconds(message.header.stamp))
            self._fail(message.header.stamp, str(error))
            return
        self._process(gray, message.header.stamp)

    def _poll_source(self) -> None:
        assert self._source is not None
        try:
            grabbed = self._source.read()
        except ImageError as error:
            self._watch.image_problem = str(error)
            return
        if grabbed is not None:
            self._process(grabbed.gray, stamps.stamp_from_nanoseconds(grabbed.stamp))

    def _process(self, gray: NDArray[np.uint8], stamp: Time) -> None:
        """Process one image and publish what it says under its own stamp."""
        started = time.perf_counter()
        taken = stamps.nanoseconds(stamp)
        if not self._watch.arrived(taken):
            # The same picture again says nothing new.
            return
        stamp = stamps.stamp_from_nanoseconds(taken - self.sensor_delay)
        if self._tracker is None:
            self._fail(stamp, self._watch.calibration_problem or NO_CALIBRATION)
            return
        try:
            observation = self._tracker.observe(gray, stamps.seconds(stamp))
        except (ValueError, ArithmeticError, cv2.error) as error:
            self._fail(stamp, str(error))
            return
        latency = self._publish(observation, gray, stamp)
        self._watch.observed(observation, latency, time.perf_counter() - started)

    def _fail(self, stamp: Time, problem: str) -> None:
        """Say at once that this image gives no state, and why."""
        self._watch.failed_with(problem)
        self.publish_state(None, problem, stamp)

    # Output

    def _publish(self, observation: LimbObservation, gray: NDArray[np.uint8], stamp: Time) -> float:
        """Publish everything; returns the latency of the state [s]."""
        assert self._tracker is not None
        pose = self._tracker.world.pose
        camera = []
        if pose is not None:
            frame = self._frame or CAMERA_FRAME
            camera = [transform(frame, pose.position, pose.rotation.T, stamp)]
        latency = self.publish_state(observation.estimate, observation.reason, stamp, camera)
        self.publish_tags([_tag_message(placed) for placed in observation.tags], stamp)
        if self._annotated.get_subscription_count() > 0:
            picture = draw_observation(gray, observation, self._tracker)
            message = Image(
                height=picture.shape[0],
                width=picture.shape[1],
                encoding="bgr8",
                step=3 * picture.shape[1],
                data=array.array("B", picture.tobytes()),
            )
            message.header.stamp = stamp
            self._annotated.publish(message)
        return latency

    def _health(self) -> Health:
        publishers = self.count_publishers(self._image_topic) if self._source is None else 0
        level, message = self._watch.report(self._tracker, publishers)
        if level != self._level:
            self._level = level
            if level == "ok":
                self.get_logger().info(message)
            else:
                self.get_logger().warning(message)
        return Health(level, message, self._watch.tracking_values(self._tracker))


def _tag_message(placed: PlacedTag) -> TagDetection:
    """Return a tag with its place, if the camera's is known."""
    tag = placed.tag
    message = TagDetection(
        id=tag.id,
        corners=tag.corners.ravel(),
        on_limb=placed.on_limb,
        pose_valid=placed.pose is not None,
        pixel_size=tag.pixel_size,
        line_residual=tag.line_residual,
    )
    if placed.pose is not None:
        x, y, yaw = placed.pose.tolist()
        message.pose = Pose2D(x=x, y=y, theta=yaw)
    return message


def main() -> int:
    """Run the node."""
    return run_node(TrackerNode)
