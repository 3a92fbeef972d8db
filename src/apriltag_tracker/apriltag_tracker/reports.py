"""What the tracker tells people: lost images, diagnostics with their remedy, what it sees.

For RViz it tells where clamp, tip and camera are, on `/tf`, where `tf2_msgs` is installed. ROS from
apt has `tf2_msgs`, its wheels have not; without it nothing is published and nothing else changes.
"""

from __future__ import annotations

import collections
import importlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation

from apriltag_tracker.camera import project
from apriltag_tracker.pipeline import LimbObservation, LimbTracker
from limb_interfaces import topics

SILENCE = 2.0
"""Without an image for this long [s] something is wrong."""

_WINDOW = 300

TF = "/tf"
CLAMP_FRAME = "limb_clamp"
"""Name of the frame at the clamped end, which is the origin of `limb_base`."""
TIP_FRAME = "limb_tip"
"""Name of the frame at the tip, x along the limb."""
CAMERA_FRAME = "limb_camera"
"""Name of the frame of a camera that names none: x right, y down, z out of the lens."""

NO_CALIBRATION = (
    "images come but no camera_info: publish it beside them, or set the parameter calibration_file "
    "(scripts/calibrate_camera.py writes one)"
)

_TAG = (60, 200, 60)
_WORLD = (220, 160, 40)
_CURVE = (40, 120, 255)
_TEXT = (40, 40, 230)
_SHIFT = 4


class StampGaps:
    """Counts what is missing between the stamps of a stream of nearly constant rate.

    The period is the interval below which a tenth of the last `window` ones lie: so even if most
    messages are lost, the few neighbours that both arrive tell it. A gap of k periods is k − 1
    missed messages; one longer than ``pause`` is a source that paused, and counts none.

    Args:
        window: intervals that tell the period.
        pause: [s].
    """

    def __init__(self, window: int = 100, pause: float = 5.0) -> None:
        self._intervals: collections.deque[int] = collections.deque(maxlen=window)
        self._pause = round(pause * 1e9)
        self._newest = 0
        self.missed = 0
        """Messages that did not arrive between those that did."""

    def take(self, stamp: int) -> None:
        """Take the stamp [ns] of a message; zero means nothing, one that goes back begins anew."""
        if stamp <= 0:
            return
        before, self._newest = self._newest, stamp
        interval = stamp - before
        if before == 0 or not 0 < interval <= self._pause:
            return
        self._intervals.append(interval)
        if len(self._intervals) >= 2:
            period = sorted(self._intervals)[len(self._intervals) // 10]
            self.missed += round(interval / period) - 1


@dataclass(frozen=True)
class ImageReport:
    """Level (`ok`, `warning`, `error`, `stale`), a sentence, and numbers by name."""

    level: str
    message: str
    values: dict[str, object]


class ImageWatch:
    """Counts images and states, and tells what is wrong.

    Args:
        source: what images come from, for the messages: a topic's name, a device or a file.
        is_topic: whether `source` is a topic.
        clock: a steady clock [s].
    """

    def __init__(
        self, source: str, is_topic: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._source = source
        self._is_topic = is_topic
        self._clock = clock
        self._started = clock()
        self.received = self.processed = self.failed = 0
        self.repeated = self.invalid = self.bridged = 0
        self.calibration_problem = ""
        self.image_problem = ""
        self._arrivals: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._latency: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._work: collections.deque[float] = collections.deque(maxlen=_WINDOW)
        self._last: LimbObservation | None = None

    def arrived(self) -> None:
        """An image came."""
        self.received += 1
        self._arrivals.append(self._clock())

    def observed(self, observation: LimbObservation, latency: float, work: float) -> None:
        """An image was processed; latency from its stamp and time of the work in s."""
        self.image_problem = ""
        self._last = observation
        self.processed += 1
        self.invalid += observation.estimate is None
        self.bridged += observation.bridged
        self._latency.append(latency)
        self._work.append(work)

    def failed_with(self, problem: str) -> None:
        """An image could not be processed."""
        self.failed += 1
        self.image_problem = problem

    def report(self, tracker: LimbTracker | None, publishers: int = 0) -> ImageReport:
        """Say how things are.

        Args:
            tracker: the tracker, None while there is no calibration.
            publishers: how many publish the image topic.
        """
        values = self._values(tracker)
        now = self._clock()
        silent = now - (self._arrivals[-1] if self._arrivals else self._started)
        if not self._arrivals or silent > SILENCE:
            level, message = self._silence(silent, publishers)
        elif tracker is None:
            level, message = "error", self.calibration_problem or NO_CALIBRATION
        elif self.image_problem:
            level, message = "error", self.image_problem
        else:
            level, message = self._tracking(tracker)
        return ImageReport(level, message, values)

    def _silence(self, silent: float, publishers: int) -> tuple[str, str]:
        level = "error" if self._arrivals else "stale"
        text = f"no image from {self._source} for {silent:.0f} s"
        if not self._is_topic:
            return "error", self.image_problem or text
        if publishers == 0:
            return level, f"{text}: nobody publishes it; start the camera, or remap the topic"
        return level, (
            f"{text} though it has {publishers} publisher(s): large images are lost with Fast "
            "DDS's default shared memory; set FASTRTPS_DEFAULT_PROFILES_FILE to "
            "apriltag_tracker/config/fastdds_large_images.xml in every process"
        )

    def _tracking(self, tracker: LimbTracker) -> tuple[str, str]:
        last, world = self._last, tracker.world
        if last is None or last.estimate is None:
            return "error", last.reason if last is not None else "no image has been processed"
        if world.excluded:
            named = ", ".join(f"{tag} ({gap:.1f} px)" for tag, gap in world.excluded.items())
            return "warning", f"fixed tags that do not fit the others: {named}"
        if world.bumps:
            return (
                "warning",
                f"the camera was moved {world.bumps} time(s); its pose was solved again",
            )
        return ("warning", last.reason) if last.reason else ("ok", "tracking")

    def _values(self, tracker: LimbTracker | None) -> dict[str, object]:
        values: dict[str, object] = {
            "images_received": self.received,
            "images_processed": self.processed,
            "images_failed": self.failed,
            "repeated_stamps": self.repeated,
            "states_invalid": self.invalid,
            "states_bridged": self.bridged,
        }
        if len(self._arrivals) > 1 and self._arrivals[-1] > self._arrivals[0]:
            rate = (len(self._arrivals) - 1) / (self._arrivals[-1] - self._arrivals[0])
            values["rate_hz"] = f"{rate:.1f}"
        for name, kept in (("latency", self._latency), ("processing", self._work)):
            if kept:
                values[f"{name}_ms_median"] = f"{1e3 * float(np.median(kept)):.2f}"
                values[f"{name}_ms_p99"] = f"{1e3 * float(np.percentile(kept, 99)):.2f}"
        if tracker is not None:
            counts, world = tracker.tracker.counts, tracker.world
            values.update(
                tags_tracked=counts.tracked,
                tags_by_full_search=counts.by_full_search,
                full_searches=counts.full_searches,
                duplicates_rejected=counts.duplicates,
                unknown_tags=dict(counts.unknown),
                tags_misplaced=tracker.misplaced,
                world_residual_px=f"{world.residual:.3f}",
                camera_bumps=world.bumps,
            )
        return values


def draw_observation(
    gray: NDArray[np.uint8], observation: LimbObservation, tracker: LimbTracker
) -> NDArray[np.uint8]:
    """Return a colour picture (rows, columns, 3) BGR with tags, curve and tip drawn in."""
    picture = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), dtype=np.uint8)
    for placed in observation.tags:
        colour = _TAG if placed.on_limb else _WORLD
        corners = placed.tag.corners
        cv2.polylines(picture, [_fixed(corners)], True, colour, 2, cv2.LINE_AA, _SHIFT)
        # The printed lower left, from which corners are counted.
        cv2.circle(
            picture, _fixed(corners[:1])[0].tolist(), 3 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT
        )
        place = tuple(int(value) for value in corners.max(axis=0))
        cv2.putText(picture, str(placed.tag.id), place, cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, 2)
    pose = tracker.world.pose
    if observation.estimate is not None and pose is not None:
        height = max(tag.height for tag in tracker.tags.limb)
        curve = observation.estimate.curve
        points = np.column_stack([curve, np.full(len(curve), height)])
        pixels = project(tracker.intrinsics, pose, points)
        cv2.polylines(picture, [_fixed(pixels)], False, _CURVE, 2, cv2.LINE_AA, _SHIFT)
        cv2.circle(
            picture, _fixed(pixels[-1:])[0].tolist(), 6 << _SHIFT, _CURVE, 2, cv2.LINE_AA, _SHIFT
        )
    if observation.reason:
        cv2.putText(
            picture, observation.reason[:100], (10, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _TEXT, 2
        )
    return picture


def _fixed(points: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(np.asarray(points) * (1 << _SHIFT)).astype(np.int32)


def transform(
    child: str, position: Sequence[float], rotation: NDArray[np.float64], stamp: Time
) -> TransformStamped:
    """Return where a frame is in `limb_base`.

    Args:
        child: the frame.
        position: (3,) m, of its origin.
        rotation: (3, 3) its axes in `limb_base`, as columns.
        stamp: when.
    """
    message = TransformStamped(child_frame_id=child)
    message.header.stamp = stamp
    message.header.frame_id = topics.BASE_FRAME
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = map(float, position)
    found = Rotation.from_matrix(rotation).as_quat(canonical=True)
    turn.x, turn.y, turn.z, turn.w = map(float, found)
    return message


def limb_transforms(curve: NDArray[np.float64], stamp: Time) -> list[TransformStamped]:
    """Return clamp and tip of a limb.

    Args:
        curve: (n, 2) m, from the clamp to the tip, n at least 2.
        stamp: when it was there.
    """
    along = curve[-1] - curve[-2]
    tip = Rotation.from_euler("z", np.arctan2(along[1], along[0])).as_matrix()
    return [
        transform(CLAMP_FRAME, (0.0, 0.0, 0.0), np.eye(3), stamp),
        transform(TIP_FRAME, (*curve[-1].tolist(), 0.0), tip, stamp),
    ]


def camera_transform(
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    stamp: Time,
    frame: str = "",
) -> TransformStamped:
    """Return the place of a camera.

    Args:
        rotation: (3, 3) from `limb_base` into the camera's optical frame.
        translation: (3,) m of the same: a point p of the base is at rotation p + translation.
        stamp: of the image.
        frame: name of the optical frame; `CAMERA_FRAME` if empty.
    """
    position = -rotation.T @ translation
    return transform(frame or CAMERA_FRAME, position.tolist(), rotation.T, stamp)


def transform_publisher(node: Node) -> Callable[[list[TransformStamped]], None] | None:
    """Return what publishes transforms of one instant on `/tf`, or None without `tf2_msgs`."""
    try:
        kind = importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None
    # The depth is that of tf2_ros.
    publisher = node.create_publisher(kind, TF, QoSProfile(depth=100))
    return lambda transforms: publisher.publish(kind(transforms=transforms))
