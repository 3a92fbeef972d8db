"""Where clamp, tip and camera are, for RViz: on `/tf`, where `tf2_msgs` is installed.

ROS from apt has `tf2_msgs`, its wheels have not; without it nothing is published and nothing else
changes.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation

from limb_interfaces import topics

TF = "/tf"
CLAMP_FRAME = "limb_clamp"
"""Name of the frame at the clamped end, which is the origin of `limb_base`."""
TIP_FRAME = "limb_tip"
"""Name of the frame at the tip, x along the limb."""
CAMERA_FRAME = "limb_camera"
"""Name of the frame of a camera that names none: x right, y down, z out of the lens."""


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
