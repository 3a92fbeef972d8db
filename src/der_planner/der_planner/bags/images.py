"""What is seen in a bag's pictures: which topics, at which stamps, and where a point appears.

The projection from the limb's plane to the image is fitted to the tags in the bag itself: the
tracker recorded where each limb tag is in pixels and in `limb_base`, and the camera's calibration
is in the bag, so no file of the rig is needed. What lies in the plane of the limb tags projects
exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from der_planner.bags.reader import BagReader
from der_planner.bags.record import PLAN_TYPE, STATE_TYPE, TRUTH_SUFFIX, header_stamp, namespace_of
from der_planner.bags.run import Array

IMAGE_TYPE = "sensor_msgs/msg/Image"
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"
TAGS_TYPE = "der_msgs/msg/TagDetectionArray"
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"
LIMB_MARKER = "planner/limb"
MINIMUM_TAGS = 20


def topics_of(bag: BagReader, type_name: str, namespace: str) -> list[str]:
    """Return the topics of a type that belong to a limb, neither simulated truth nor drawings.

    Args:
        bag: open.
        type_name: ``package/msg/Name``.
        namespace: of the limb. Where it has no such topic, those that lie in no limb's namespace
            are returned: a camera of the rig may have a name of its own.
    """
    limbs = {
        namespace_of(topic.name)
        for topic in bag.topics.values()
        if topic.type_name in (PLAN_TYPE, STATE_TYPE)
    }
    named = [
        topic.name
        for topic in bag.topics.values()
        if topic.type_name == type_name
        and not topic.name.endswith((TRUTH_SUFFIX, "image_annotated"))
    ]
    own = [name for name in named if _lies_in(name, namespace)]
    return own or [name for name in named if not any(_lies_in(name, limb) for limb in limbs)]


def _lies_in(topic: str, namespace: str) -> bool:
    return topic.startswith(namespace.rstrip("/") + "/")


def stamp_of(message: Any) -> int | None:
    """Return the stamp of a message [ns]; of the limb's line for markers."""
    if hasattr(message, "markers"):
        lines = [marker for marker in message.markers if marker.ns == LIMB_MARKER]
        if not lines:
            return None
        message = lines[0]
    return header_stamp(message)


def curve_points(points: Sequence[Any]) -> Array:
    """Return messages' points as (N, 2)."""
    return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)


def gray(image: Any) -> NDArray[np.uint8] | None:
    """Return an image message as (H, W) gray values, None for an encoding that is not known."""
    data = np.frombuffer(bytes(image.data), dtype=np.uint8)
    rows = data.reshape(image.height, image.step)
    if image.encoding in ("mono8", "8UC1"):
        return rows[:, : image.width]
    if image.encoding in ("bgr8", "rgb8"):
        colours = rows[:, : 3 * image.width].reshape(image.height, image.width, 3)
        code = cv2.COLOR_BGR2GRAY if image.encoding == "bgr8" else cv2.COLOR_RGB2GRAY
        return np.asarray(cv2.cvtColor(colours, code), dtype=np.uint8)
    return None


@dataclass(frozen=True)
class Projection:
    """From the plane of the limb's tags to pixels.

    Attributes:
        homography: (3, 3) from metres to normalised, undistorted image coordinates.
        camera: (3, 3) intrinsic matrix [px].
        distortion: coefficients of ``plumb_bob``.
        residual: RMS distance of projected and detected tag centres [px].
    """

    homography: Array
    camera: Array
    distortion: Array
    residual: float

    def __call__(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 2) [m]."""
        if not len(points):
            return np.empty((0, 2))
        lifted = np.column_stack([points, np.ones(len(points))]) @ self.homography.T
        rays = np.column_stack([lifted[:, :2] / lifted[:, 2:], np.ones(len(points))])
        pixels, _ = cv2.projectPoints(
            rays[:, None, :], np.zeros(3), np.zeros(3), self.camera, self.distortion
        )
        return np.asarray(pixels[:, 0, :], dtype=float)


@dataclass
class TagSights:
    """Where limb tags were seen, in pixels and in metres, and the camera's calibration.

    Attributes:
        info: the `sensor_msgs/CameraInfo` message; None before it came.
        pixels: centres of tags [px].
        plane: the same centres in `limb_base` [m].
    """

    info: Any = None
    pixels: list[tuple[float, float]] = field(default_factory=list)
    plane: list[tuple[float, float]] = field(default_factory=list)

    def add(self, message: Any) -> None:
        """Take the tags of one image."""
        for tag in message.detections:
            if tag.on_limb and tag.pose_valid:
                self.pixels.append(_centre(np.asarray(tag.corners).reshape(4, 2)))
                self.plane.append((tag.pose.x, tag.pose.y))

    def projection(self) -> Projection | None:
        """Fit the projection; None without a calibration or with too few tags."""
        if self.info is None or len(self.pixels) < MINIMUM_TAGS:
            return None
        camera, distortion = np.array(self.info.k).reshape(3, 3), np.array(self.info.d)
        pixels, plane = np.array(self.pixels), np.array(self.plane)
        normal = cv2.undistortPoints(pixels[:, None, :], camera, distortion)[:, 0, :]
        homography, _ = cv2.findHomography(plane, normal, 0)
        if homography is None:
            return None
        fitted = Projection(np.asarray(homography), camera, distortion, 0.0)
        misses = np.linalg.norm(fitted(plane) - pixels, axis=1)
        residual = float(np.sqrt(np.mean(misses**2)))
        return Projection(np.asarray(homography), camera, distortion, residual)


def _centre(corners: Array) -> tuple[float, float]:
    """Return the image of a square's centre: where its diagonals cross."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    share = np.linalg.solve(np.column_stack([first, -second]), corners[1] - corners[0])[0]
    x, y = corners[0] + share * first
    return float(x), float(y)
