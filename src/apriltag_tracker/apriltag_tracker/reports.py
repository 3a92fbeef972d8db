"""What the tracker of images tells people: diagnostics with their remedy, and what it sees."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import project
from apriltag_tracker.pipeline import LimbObservation, LimbTracker
from apriltag_tracker.watching import StreamWatch

NO_CALIBRATION = (
    "images come but no camera_info: publish it beside them, or set the parameter calibration_file "
    "(scripts/calibrate_camera.py writes one)"
)

_REPEATS = 10
"""So many images in a row with one stamp are more than a picture that was sent again."""
_SIZE_ERROR = 0.03
"""Tags of 14 px look larger or smaller by a third of this from noise."""
_TAG = (60, 200, 60)
_WORLD = (220, 160, 40)
_CURVE = (40, 120, 255)
_TEXT = (40, 40, 230)
_SHIFT = 4


class ImageWatch(StreamWatch):
    """Counts images and states, and tells what is wrong.

    Args:
        source: what images come from, for the messages: a topic's name, a device or a file.
        is_topic: whether `source` is a topic.
        clock: a steady clock [s].
    """

    def __init__(
        self, source: str, is_topic: bool, clock: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(source, "image", clock)
        self._is_topic = is_topic
        self.calibration_problem = ""
        self.image_problem = ""
        self._last: LimbObservation | None = None

    def observed(self, observation: LimbObservation, latency: float, work: float) -> None:
        """An image was processed; latency from its stamp and time of the work in s."""
        self.image_problem = ""
        self._last = observation
        self.counted(observation.estimate is not None, observation.bridged, latency, work)

    def failed_with(self, problem: str) -> None:
        """An image could not be processed."""
        self.failed += 1
        self.image_problem = problem

    def report(self, tracker: LimbTracker | None, publishers: int = 0) -> tuple[str, str]:
        """Say how things are: the level (`ok`, `warning`, `error`, `stale`) and a sentence.

        Args:
            tracker: the tracker, None while there is no calibration.
            publishers: how many publish the image topic.
        """
        if silence := self.silence():
            return self._silence(*silence, publishers)
        if self._again > _REPEATS:
            return "error", f"images from {self._source} have no stamps, or all the same: set them"
        if tracker is None:
            return "error", self.calibration_problem or NO_CALIBRATION
        if self.image_problem:
            return "error", self.image_problem
        return self._tracking(tracker)

    def _silence(self, level: str, text: str, publishers: int) -> tuple[str, str]:
        if not self._is_topic:
            return "error", self.image_problem or text
        if publishers == 0:
            return level, f"{text}: nobody publishes it; start the camera, or remap the topic"
        if level == "error":
            return level, f"{text}: see whether the camera's node still runs"
        return level, (
            f"{text} though it has {publishers} publisher(s): large images are lost with Fast "
            "DDS's default shared memory; set FASTRTPS_DEFAULT_PROFILES_FILE to "
            "apriltag_tracker/config/fastdds_large_images.xml in every process"
        )

    def _tracking(self, tracker: LimbTracker) -> tuple[str, str]:
        last, world = self._last, tracker.world
        if last is None or last.estimate is None:
            return "error", last.reason if last is not None else "no image has been processed"
        if clock := self.other_clock():
            return "warning", clock
        if world.excluded:
            named = ", ".join(f"{tag} ({gap:.1f} px)" for tag, gap in world.excluded.items())
            return "warning", f"fixed tags that do not fit the others: {named}"
        if tracker.size_error > _SIZE_ERROR:
            off = f"the limb's tags look {100 * tracker.size_error:.0f} % larger or smaller"
            return "warning", f"{off} than the tag map says: check height and size"
        if world.bumps:
            return (
                "warning",
                f"the camera was moved {world.bumps} time(s); its pose was solved again",
            )
        return ("warning", last.reason) if last.reason else ("ok", "tracking")

    def tracking_values(self, tracker: LimbTracker | None) -> dict[str, object]:
        """Return the numbers by name, those of the tracker too."""
        values = self.values()
        if tracker is not None:
            counts, world = tracker.tracker.counts, tracker.world
            values.update(
                full_searches=counts.full_searches,
                duplicates_rejected=counts.duplicates,
                unknown_tags=dict(counts.unknown),
                tags_misplaced=tracker.follower.misplaced,
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
