"""Draw what the tracker saw into the picture it saw it in."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import project
from apriltag_tracker.pipeline import LimbObservation, LimbTracker

_TAG = (60, 200, 60)
_WORLD = (220, 160, 40)
_CURVE = (40, 120, 255)
_TEXT = (40, 40, 230)
_SHIFT = 4


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
