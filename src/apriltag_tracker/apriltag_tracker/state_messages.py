"""The limb's state as messages: `state`, markers for RViz and Foxglove, and transforms for RViz."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, TransformStamped
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker, MarkerArray

from apriltag_tracker.pose.shape import LimbEstimate
from der_msgs.msg import LimbState
from limb_interfaces import topics

CLAMP_FRAME = "limb_clamp"
"""Name of the frame at the clamped end, which is the origin of `limb_base`."""
TIP_FRAME = "limb_tip"
"""Name of the frame at the tip, x along the limb."""
CAMERA_FRAME = "limb_camera"
"""Name of the frame of a camera that names none: x right, y down, z out of the lens."""


def limb_state(
    estimate: LimbEstimate | None, reason: str, stamp: Time, segment_count: int
) -> LimbState:
    """Return a limb as a message without its latency.

    Args:
        estimate: the limb; None if it cannot be told.
        reason: why not, or what was bridged or left out.
        stamp: when it was so.
        segment_count: M.
    """
    message = LimbState(reason=reason)
    message.header.stamp = stamp
    message.header.frame_id = topics.BASE_FRAME
    if estimate is None:
        nan = math.nan
        message.tip = Point(x=nan, y=nan, z=nan)
        message.tip_covariance = message.tip_systematic = [nan] * 4
        message.bend_angle = message.bend_angle_sigma = [nan] * segment_count
        message.curvature = [nan] * segment_count
        message.elongation = message.residual = nan
        return message
    message.valid = True
    message.tip = Point(x=float(estimate.tip[0]), y=float(estimate.tip[1]), z=0.0)
    message.tip_covariance = estimate.tip_covariance.ravel()
    message.tip_systematic = estimate.tip_systematic.ravel()
    message.bend_angle = estimate.bend_angle.tolist()
    message.bend_angle_sigma = estimate.bend_angle_sigma.tolist()
    message.curvature = estimate.curvature.tolist()
    message.elongation = estimate.elongation
    message.residual = estimate.residual
    message.curve = [Point(x=x, y=y) for x, y in estimate.curve.tolist()]
    message.tags_used = len(estimate.tags_used)
    return message


def limb_markers(state: LimbState) -> MarkerArray:
    """Draw the measured limb and its tip for RViz and Foxglove."""
    line = Marker(ns="measured", id=0, type=Marker.LINE_STRIP, points=list(state.curve))
    tip = Marker(ns="measured", id=1, type=Marker.SPHERE)
    for marker in (line, tip):
        marker.header = state.header
        marker.color.g = marker.color.b = 0.7
        marker.color.a = 1.0
        marker.pose.orientation.w = 1.0
    line.scale.x = 0.004
    tip.pose.position = state.tip
    tip.scale.x = tip.scale.y = tip.scale.z = 0.01
    return MarkerArray(markers=[line, tip])


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


def transforms_type() -> Any:
    """Return the type of messages on `/tf`; None where `tf2_msgs` is not installed.

    ROS from apt has it, its wheels have not; without it nothing else changes.
    """
    try:
        return importlib.import_module("tf2_msgs.msg").TFMessage
    except ImportError:
        return None
