"""What a bag shows of a limb: the camera's frames, and the curves of what was measured and planned.

The projection from the limb's plane to the image is fitted to the tags in the bag itself: the
tracker recorded where each limb tag is in pixels and in `limb_base`, and the camera's calibration
is in the bag, so no file of the rig is needed. What lies in the plane of the limb tags projects
exactly.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array, points_of
from der_planner.bags.reader import BagReader
from der_planner.bags.record import NANOSECONDS, STATE_TYPE, TRUTH_SUFFIX, header_stamp
from der_planner.bags.run import RunSeries

IMAGE_TYPE = "sensor_msgs/msg/Image"
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"
TAGS_TYPE = "der_msgs/msg/TagDetectionArray"
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"
LIMB_MARKER = "planner/limb"
"""Namespace of the marker that shows the planner's reference limb."""
MINIMUM_TAGS = 20
"""Least number of seen limb tags that a projection is fitted to."""
FITTED = 60.0
"""The projection is fitted to the tags of the first part of a run of this length [s]."""
DELAYED = 5.0
"""The delay of pictures is found in the first part of a run of this length [s]."""
TOGETHER = 0.015
"""A picture and a measured limb within this time are of one instant [s]: half a frame."""
NEAR = 0.5
"""Messages within this time of an instant may belong to it [s]."""

Picture = NDArray[np.uint8]
_NOTHING = np.empty((0, 2))


@dataclass(frozen=True)
class Projection:
    """From the plane of the limb's tags to pixels.

    Attributes:
        homography: (3, 3) from metres to normalised, undistorted image coordinates.
        camera: (3, 3) intrinsic matrix [px].
        distortion: coefficients of ``plumb_bob``.
    """

    homography: Array
    camera: Array
    distortion: Array

    def __call__(self, points: Array) -> Array:
        """Return pixels (N, 2) of points (N, 2) [m]."""
        if not len(points):
            return _NOTHING
        lifted = np.column_stack([points, np.ones(len(points))]) @ self.homography.T
        rays = np.column_stack([lifted[:, :2] / lifted[:, 2:], np.ones(len(points))])
        pixels, _ = cv2.projectPoints(
            rays[:, None, :], np.zeros(3), np.zeros(3), self.camera, self.distortion
        )
        return np.asarray(pixels[:, 0, :], dtype=float)


class Snapshot(NamedTuple):
    """The limb at one instant.

    Attributes:
        picture: (H, W) gray image nearest in time, or None where the bag has no images.
        measured: (N, 2) curve of the tracker [m], empty where it had none.
        planned: (N, 2) curve of the planner's reference limb [m], empty where it published none.
    """

    picture: Picture | None
    measured: Array
    planned: Array


class RunImages:
    """What a bag shows of one run.

    Args:
        bag: open.
        run: of this bag.
    """

    def __init__(self, bag: BagReader, run: RunSeries) -> None:
        self._bag = bag
        self._origin = run.origin
        self._topics = {
            type_name: _topics_of(bag, type_name, run.description.namespace)[:1]
            for type_name in (IMAGE_TYPE, CAMERA_TYPE, TAGS_TYPE, STATE_TYPE, MARKERS_TYPE)
        }
        self._late = self._delay()

    def _delay(self) -> int:
        """Return by how much pictures are stamped later than their states, which are right [ns]."""
        last = self._origin + round(DELAYED * NANOSECONDS)
        images, states = (
            [header_stamp(each) for _, _, each in self._bag.messages(topics, self._origin, last)]
            for topics in (self._topics[IMAGE_TYPE], self._topics[STATE_TYPE])
        )
        # The tracker takes the same time off every stamp.
        gaps = Counter(image - state for image in images for state in states)
        return max(gaps, key=lambda gap: (gaps[gap], -abs(gap)), default=0)

    def projection(self) -> Projection | None:
        """Fit the projection; None without a calibration or with too few tags."""
        info, pixels, plane = None, [], []
        wanted = self._topics[CAMERA_TYPE] + self._topics[TAGS_TYPE]
        last = self._origin + round(FITTED * NANOSECONDS)
        for topic, _, message in self._bag.messages(wanted, None, last):
            if topic in self._topics[CAMERA_TYPE]:
                info = message
                continue
            for tag in message.detections:
                if tag.on_limb and tag.pose_valid:
                    pixels.append(np.asarray(tag.corners).reshape(4, 2).mean(axis=0))
                    plane.append((tag.pose.x, tag.pose.y))
        # A camera that is not calibrated tells zeros.
        if info is None or not np.any(info.k) or len(pixels) < MINIMUM_TAGS:
            return None
        camera, distortion = np.array(info.k).reshape(3, 3), np.array(info.d)
        normal = cv2.undistortPoints(np.array(pixels)[:, None, :], camera, distortion)[:, 0, :]
        homography, _ = cv2.findHomography(np.array(plane), normal, 0)
        if homography is None:
            return None
        return Projection(np.asarray(homography), camera, distortion)

    def snapshot(self, time: float) -> Snapshot:
        """Return what is nearest to an instant, of each kind.

        Args:
            time: [s] since the first setpoint.
        """
        when, near = self._origin + round(time * NANOSECONDS), round(NEAR * NANOSECONDS)
        late = when + self._late
        read = self._bag.messages(self._topics[IMAGE_TYPE], late - near, late + near)
        images = [message for _, _, message in read]
        image = min(images, key=lambda each: abs(header_stamp(each) - late), default=None)
        picture = None if image is None else gray(image)
        curves = self._curves(when - near, when + near)
        return Snapshot(picture, *(_nearest_curve(each, when, NEAR) for each in curves))

    def pictures(self) -> Iterator[tuple[float, Snapshot]]:
        """Yield the limb at each picture, with the time [s] since the first setpoint.

        Pictures of an encoding that is not known are left out.
        """
        measured, planned = self._curves()
        for _, _, message in self._bag.messages(self._topics[IMAGE_TYPE]):
            picture, stamp = gray(message), header_stamp(message) - self._late
            if picture is not None:
                time = (stamp - self._origin) / NANOSECONDS
                seen = _nearest_curve(measured, stamp, TOGETHER)
                yield time, Snapshot(picture, seen, _nearest_curve(planned, stamp, NEAR))

    def _curves(
        self, start: int | None = None, stop: int | None = None
    ) -> tuple[dict[int, Array], dict[int, Array]]:
        """Return the measured and the planned limb by stamp, logged between two times [ns]."""
        measured = {
            header_stamp(message): points_of(message.curve if message.valid else [])
            for _, _, message in self._bag.messages(self._topics[STATE_TYPE], start, stop)
        }
        planned = {
            header_stamp(marker): points_of(marker.points)
            for _, _, message in self._bag.messages(self._topics[MARKERS_TYPE], start, stop)
            for marker in message.markers
            if marker.ns == LIMB_MARKER
        }
        return measured, planned


def _nearest_curve(curves: dict[int, Array], stamp: int, within: float) -> Array:
    """Return the curve nearest to a stamp [ns], an empty one if none is within some s."""
    near = min(curves, key=lambda each: abs(each - stamp), default=0)
    return curves[near] if abs(near - stamp) < within * NANOSECONDS else _NOTHING


def _topics_of(bag: BagReader, type_name: str, namespace: str) -> list[str]:
    """Return the topics of a type, neither simulated truth nor drawings.

    They are those of the limb's namespace, if there are any: a camera of the rig may have a name of
    its own.
    """
    named = [
        each.name
        for each in bag.topics.values()
        if each.type_name == type_name and not each.name.endswith((TRUTH_SUFFIX, "image_annotated"))
    ]
    return [name for name in named if name.startswith(f"{namespace.rstrip('/')}/")] or named


def gray(image: Any) -> Picture | None:
    """Return an image message as (H, W) gray values, None for an encoding that is not known."""
    # Only who looks at pictures needs the tracker.
    from apriltag_tracker.camera.images import ImageError, ImageReader  # noqa: PLC0415

    try:
        return ImageReader().to_grey(image)
    except ImageError:
        return None
