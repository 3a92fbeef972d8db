"""The limb at chosen instants of a recorded run: camera frame, measured and planned shape.

The projection from the limb's plane to the image is fitted to the tags in the bag itself: the
tracker recorded where each limb tag is in pixels and in `limb_base`, and the camera's calibration
is in the bag, so no file of the rig is needed. What lies in the plane of the limb tags projects
exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from der_planner.runs.recording.reader import BagReader
from der_planner.runs.run import Array, RunSeries
from der_planner.runs.series import NANOSECONDS, PLAN_TYPE, STATE_TYPE, TRUTH_SUFFIX, namespace_of

IMAGE_TYPE = "sensor_msgs/msg/Image"
CAMERA_TYPE = "sensor_msgs/msg/CameraInfo"
TAGS_TYPE = "der_msgs/msg/TagDetectionArray"
MARKERS_TYPE = "visualization_msgs/msg/MarkerArray"
LIMB_MARKER = "planner/limb"
MARGIN = 0.5
"""Messages within so many seconds of an instant may belong to it."""
MINIMUM_TAGS = 20


@dataclass(frozen=True)
class Snapshot:
    """The limb at one instant.

    Attributes:
        time: asked for [s] since the first setpoint.
        frame: (H, W) gray image nearest in time, or None where the bag has no images.
        measured: (N, 2) curve of the tracker [m], empty where it had none.
        planned: (N, 2) curve of the planner's reference limb [m], empty where it published none.
    """

    time: float
    frame: NDArray[np.uint8] | None
    measured: Array
    planned: Array


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


def take_snapshots(run: RunSeries, times: Sequence[float]) -> list[Snapshot]:
    """Read the limb's shape, and the frames where there are any, at some instants of a bag.

    Args:
        run: of a bag.
        times: [s] since the first setpoint.

    Raises:
        BagError: the bag cannot be read.
    """
    with BagReader(run.description.bag) as bag:
        return [_snapshot(bag, run, time) for time in times]


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


def _snapshot(bag: BagReader, run: RunSeries, time: float) -> Snapshot:
    space = run.description.namespace
    when = run.origin + round(time * NANOSECONDS)
    window = (when - round(MARGIN * NANOSECONDS), when + round(MARGIN * NANOSECONDS))
    states, images = topics_of(bag, STATE_TYPE, space)[:1], topics_of(bag, IMAGE_TYPE, space)[:1]
    markers = topics_of(bag, MARKERS_TYPE, space)[:1]
    nearest: dict[str, tuple[int, Any]] = {}
    for topic, _, message in bag.messages([*states, *images, *markers], *window):
        stamp = stamp_of(message)
        if stamp is None:
            continue
        away = abs(stamp - when)
        if topic not in nearest or away < nearest[topic][0]:
            nearest[topic] = (away, message)
    found = {topic: message for topic, (_, message) in nearest.items()}
    state = next((found[name] for name in states if name in found), None)
    image = next((found[name] for name in images if name in found), None)
    marker = next((found[name] for name in markers if name in found), None)
    return Snapshot(
        time=time,
        frame=gray(image) if image is not None else None,
        measured=curve_points(state.curve)
        if state is not None and state.valid
        else np.empty((0, 2)),
        planned=_limb_of(marker),
    )


def stamp_of(message: Any) -> int | None:
    """Return the stamp of a message [ns]; of the limb's line for markers."""
    if hasattr(message, "markers"):
        lines = [marker for marker in message.markers if marker.ns == LIMB_MARKER]
        if not lines:
            return None
        message = lines[0]
    return int(message.header.stamp.sec) * NANOSECONDS + int(message.header.stamp.nanosec)


def _limb_of(message: Any) -> Array:
    if message is None:
        return np.empty((0, 2))
    return curve_points(
        next(marker.points for marker in message.markers if marker.ns == LIMB_MARKER)
    )


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


def fit_projection(run: RunSeries, seconds: float = 60.0) -> Projection | None:
    """Fit the projection to the limb tags of the first part of a run.

    Args:
        run: of a bag.
        seconds: how much of the run to read.

    Returns:
        None where the bag lacks the camera's calibration or has too few tags.
    """
    with BagReader(run.description.bag) as bag:
        space = run.description.namespace
        cameras, tags = topics_of(bag, CAMERA_TYPE, space)[:1], topics_of(bag, TAGS_TYPE, space)[:1]
        info: Any = None
        pixels: list[list[float]] = []
        plane: list[list[float]] = []
        last = run.origin + round(seconds * NANOSECONDS)
        for topic, _, message in bag.messages([*cameras, *tags], None, last):
            if topic in cameras:
                info = message
                continue
            for tag in message.detections:
                if tag.on_limb and tag.pose_valid:
                    pixels.append(list(_centre(np.asarray(tag.corners).reshape(4, 2))))
                    plane.append([tag.pose.x, tag.pose.y])
    if info is None or len(pixels) < MINIMUM_TAGS:
        return None
    camera, distortion = np.array(info.k).reshape(3, 3), np.array(info.d)
    normal = cv2.undistortPoints(np.array(pixels)[:, None, :], camera, distortion)[:, 0, :]
    homography, _ = cv2.findHomography(np.array(plane), normal, 0)
    if homography is None:
        return None
    fitted = Projection(np.asarray(homography), camera, distortion, 0.0)
    misses = np.linalg.norm(fitted(np.array(plane)) - np.array(pixels), axis=1)
    return Projection(
        np.asarray(homography), camera, distortion, float(np.sqrt(np.mean(misses**2)))
    )


def _centre(corners: Array) -> Array:
    """Return the image of a square's centre: where its diagonals cross."""
    first, second = corners[2] - corners[0], corners[3] - corners[1]
    share = np.linalg.solve(np.column_stack([first, -second]), corners[1] - corners[0])[0]
    return np.asarray(corners[0] + share * first)
