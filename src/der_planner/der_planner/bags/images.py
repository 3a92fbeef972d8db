"""The pictures of a recorded run, the limb in them, and where a point of the plane appears.

The projection from the limb's plane to the image is fitted to the tags in the bag itself: the
tracker recorded where each limb tag is in pixels and in `limb_base`, and the camera's calibration
is in the bag, so no file of the rig is needed. What lies in the plane of the limb tags projects
exactly.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.bags.reader import BagReader
from der_planner.bags.record import (
    NANOSECONDS,
    PLAN_TYPE,
    STATE_TYPE,
    TRUTH_SUFFIX,
    header_stamp,
    namespace_of,
)
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
    """What a bag shows of one run; a context manager.

    Args:
        run: of a bag.

    Raises:
        BagError: the bag cannot be read.
    """

    def __init__(self, run: RunSeries) -> None:
        self._bag = BagReader(run.description.bag)
        self._origin = run.origin
        self._topics = {
            type_name: _topics_of(self._bag, type_name, run.description.namespace)[:1]
            for type_name in (IMAGE_TYPE, CAMERA_TYPE, TAGS_TYPE, STATE_TYPE, MARKERS_TYPE)
        }

    def __enter__(self) -> RunImages:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bag.__exit__(kind, error, trace)

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
                    pixels.append(_centre(np.asarray(tag.corners).reshape(4, 2)))
                    plane.append((tag.pose.x, tag.pose.y))
        if info is None or len(pixels) < MINIMUM_TAGS:
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
        nearest: dict[str, tuple[int, Any]] = {}
        wanted = [
            name for kind in (STATE_TYPE, IMAGE_TYPE, MARKERS_TYPE) for name in self._topics[kind]
        ]
        for topic, _, message in self._bag.messages(wanted, when - near, when + near):
            marker = _limb_marker(message)
            if marker is None:
                continue
            away = abs(header_stamp(marker) - when)
            if topic not in nearest or away < nearest[topic][0]:
                nearest[topic] = (away, marker)

        def found(kind: str) -> Any:
            return next((nearest[name][1] for name in self._topics[kind] if name in nearest), None)

        state, image, limb = found(STATE_TYPE), found(IMAGE_TYPE), found(MARKERS_TYPE)
        return Snapshot(
            None if image is None else gray(image),
            _NOTHING if state is None or not state.valid else _points(state.curve),
            _NOTHING if limb is None else _points(limb.points),
        )

    def pictures(self) -> Iterator[tuple[float, Picture, Array]]:
        """Yield each picture: its time [s] since the first setpoint, gray values, measured curve.

        Pictures of an encoding that is not known are left out.
        """
        curves = {
            header_stamp(message): _points(message.curve)
            for _, _, message in self._bag.messages(self._topics[STATE_TYPE])
            if message.valid
        }
        for _, _, message in self._bag.messages(self._topics[IMAGE_TYPE]):
            picture, stamp = gray(message), header_stamp(message)
            if picture is not None:
                time = (stamp - self._origin) / NANOSECONDS
                yield time, picture, curves.get(stamp, _NOTHING)


def _topics_of(bag: BagReader, type_name: str, namespace: str) -> list[str]:
    """Return the topics of a type that belong to a limb, neither simulated truth nor drawings.

    Where the limb's namespace has no such topic, those that lie in no limb's namespace are
    returned: a camera of the rig may have a name of its own.
    """
    topics = bag.topics.values()
    limbs = [
        namespace_of(each.name) for each in topics if each.type_name in (PLAN_TYPE, STATE_TYPE)
    ]
    named = [
        each.name
        for each in topics
        if each.type_name == type_name and not each.name.endswith((TRUTH_SUFFIX, "image_annotated"))
    ]

    def lies_in(topic: str, space: str) -> bool:
        return topic.startswith(space.rstrip("/") + "/")

    own = [name for name in named if lies_in(name, namespace)]
    return own or [name for name in named if not any(lies_in(name, limb) for limb in limbs)]


def _limb_marker(message: Any) -> Any:
    """Return the limb's line of a `MarkerArray`, None where it has none; another message itself."""
    if not hasattr(message, "markers"):
        return message
    return next((marker for marker in message.markers if marker.ns == LIMB_MARKER), None)


def _points(points: Sequence[Any]) -> Array:
    """Return messages' points as (N, 2)."""
    return np.array([[point.x, point.y] for point in points]).reshape(-1, 2)


def _centre(corners: Array) -> tuple[float, float]:
    """Return the image of a square's centre: where its diagonals cross."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    share = np.linalg.solve(np.column_stack([first, -second]), corners[1] - corners[0])[0]
    x, y = corners[0] + share * first
    return float(x), float(y)


def gray(image: Any) -> Picture | None:
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
