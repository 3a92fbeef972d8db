"""Where clamp, tip and camera are, for RViz: on `/tf`, where `tf2_msgs` is installed.

ROS from apt has `tf2_msgs`, its wheels have not; without it nothing is published and nothing else
changes.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node

from limb_interfaces import qos, topics

TF = "/tf"
CLAMP_FRAME = "limb_clamp"
"""The clamped end: the origin of `limb_base`, under a name of its own."""
TIP_FRAME = "limb_tip"
"""At the tip, x along the limb."""
CAMERA_FRAME = "limb_camera"
"""Of a camera that names no frame of its own: x right, y down, z out of the lens."""


def quaternion(rotation: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation matrix (3, 3), w not negative (Shepperd 1978)."""
    trace = float(np.trace(rotation))
    squares = np.array([*(2.0 * np.diag(rotation) - trace), trace]) + 1.0
    largest = int(np.argmax(squares))
    skew = [
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    ]
    if largest == 3:
        parts = np.array([*skew, squares[3]])
    else:
        parts = np.array([*(rotation[largest] + rotation[:, largest]), skew[largest]])
        parts[largest] = squares[largest]
    parts = parts / np.linalg.norm(parts) * (1.0 if parts[3] >= 0.0 else -1.0)
    x, y, z, w = parts.tolist()
    return x, y, z, w


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
    turn.x, turn.y, turn.z, turn.w = quaternion(rotation)
    return message


def about_z(angle: float) -> NDArray[np.float64]:
    """Return the rotation (3, 3) by an angle [rad] about z."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def limb_transforms(curve: NDArray[np.float64], stamp: Time) -> list[TransformStamped]:
    """Return clamp and tip of a limb.

    Args:
        curve: (n, 2) m, from the clamp to the tip, n at least 2.
        stamp: when it was there.
    """
    along = curve[-1] - curve[-2]
    tip = about_z(math.atan2(along[1], along[0]))
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


class TransformPublisher:
    """Publishes transforms on `/tf` if `tf2_msgs` is installed, and otherwise nothing.

    Args:
        node: that publishes.
    """

    def __init__(self, node: Node) -> None:
        self._message: Any = None
        try:
            self._message = importlib.import_module("tf2_msgs.msg").TFMessage
        except ImportError:
            return
        self._publisher = node.create_publisher(self._message, TF, qos.TRANSFORMS)

    @property
    def active(self) -> bool:
        """Whether `tf2_msgs` is there."""
        return self._message is not None

    def publish(self, transforms: list[TransformStamped]) -> None:
        """Publish transforms that belong to one instant."""
        if self._message is not None and transforms:
            self._publisher.publish(self._message(transforms=transforms))
