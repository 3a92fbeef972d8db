"""The messages in which other trackers tell poses: to frames of the pose tracker, and back.

Two of them are in packages that not every machine has: `tf2_msgs` comes with ROS from apt,
`motion_capture_tracking_interfaces` with its own package.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose, PoseArray, PoseStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.tracker import FrameAssembler, PoseFrame
from limb_interfaces import qos, stamps

FORMS = ("pose_stamped", "pose_array", "tf", "named_pose_array")
"""Ways in which poses come."""
BODY = "{body}"
"""Stands in the name of a topic for that of a body."""
TOPICS = {
    "pose_stamped": f"poses/{BODY}/pose",
    "pose_array": "poses",
    "tf": "/tf",
    "named_pose_array": "/poses",
}
"""Topic of each form where none is named."""
_TYPES = {
    "pose_stamped": ("geometry_msgs.msg", "PoseStamped"),
    "pose_array": ("geometry_msgs.msg", "PoseArray"),
    "tf": ("tf2_msgs.msg", "TFMessage"),
    "named_pose_array": ("motion_capture_tracking_interfaces.msg", "NamedPoseArray"),
}


class PoseFormError(RuntimeError):
    """Poses cannot come in this way here; the message says what to install or to set."""


def message_type(form: str) -> Any:
    """Return the type of a form's messages.

    Raises:
        PoseFormError: its package is not installed.
    """
    module, name = _TYPES[form]
    try:
        return getattr(importlib.import_module(module), name)
    except ImportError as error:
        package = module.split(".")[0]
        raise PoseFormError(
            f"form '{form}' needs the package {package}: install ros-jazzy-"
            f"{package.replace('_', '-')}, or have the poses published as geometry_msgs"
        ) from error


def topics_of(form: str, topic: str, names: tuple[str, ...]) -> dict[str, str]:
    """Return the topic of each body, or of all under an empty name.

    Raises:
        PoseFormError: each body has a topic of its own, and the name does not say where that of the
            body is to stand.
    """
    topic = topic or TOPICS[form]
    if form != "pose_stamped":
        return {"": topic}
    if BODY not in topic and len(names) > 1:
        raise PoseFormError(f"topic '{topic}': write {BODY} where the name of a body is to stand")
    return {name: topic.replace(BODY, name) for name in names}


class PoseSubscriber:
    """Subscribes to poses and hands on frames of them.

    Args:
        node: that subscribes.
        form: of `FORMS`.
        topic: with `BODY` for the name of a body; empty: that of `TOPICS`.
        bodies: the body map.
        take: called with every frame.

    Raises:
        PoseFormError: the form's package is not installed, or the topic does not fit it.
    """

    def __init__(
        self, node: Node, form: str, topic: str, bodies: BodyMap, take: Callable[[PoseFrame], None]
    ) -> None:
        self._clock, self._bodies, self._take = node.get_clock(), bodies, take
        self.assembler = FrameAssembler(bodies)
        self.wrong_size = ""
        """What is wrong with the size of a message without names."""
        kind = message_type(form)
        self.topics = topics_of(form, topic, bodies.names)
        for name, place in self.topics.items():
            node.create_subscription(kind, place, self._reader(form, name), qos.POSES)

    def _reader(self, form: str, name: str) -> Callable[[Any], None]:
        """Return what takes messages of a form; ``name`` is that of the body of the topic."""
        if form == "pose_stamped":
            return lambda message: self._add(message.header, {name: message.pose})
        if form == "pose_array":
            return self._on_array
        if form == "tf":
            return self._on_transforms
        return lambda message: self._add(
            message.header, {each.name: each.pose for each in message.poses}
        )

    def _on_array(self, message: PoseArray) -> None:
        names = self._bodies.names
        if len(message.poses) != len(names):
            self.wrong_size = (
                f"an array of {len(message.poses)} poses came, the body map has {len(names)} bodies"
            )
            return
        self.wrong_size = ""
        self._add(message.header, dict(zip(names, message.poses, strict=True)))

    def _on_transforms(self, message: Any) -> None:
        for each in message.transforms:
            place, turn = each.transform.translation, each.transform.rotation
            pose = (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
            self._one(each.child_frame_id, self._stamp(each.header), pose)

    def _add(self, header: Any, poses: dict[str, Pose]) -> None:
        stamp = self._stamp(header)
        for name, pose in poses.items():
            place, turn = pose.position, pose.orientation
            self._one(name, stamp, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))

    def _one(self, name: str, stamp: int, pose: tuple[float, ...]) -> None:
        frame = self.assembler.take(name, stamp, pose)
        if frame is not None:
            self._take(frame)

    def _stamp(self, header: Any) -> int:
        """Return when it was [ns]; a message without a stamp is of now."""
        return stamps.nanoseconds(header.stamp) or int(self._clock.now().nanoseconds)


def pose_messages(
    form: str, names: tuple[str, ...], frame: PoseFrame, frame_id: str
) -> dict[str, Any]:
    """Return a frame as messages of a form, by body, or all under an empty name.

    Bodies that are missing are left out, or NaN in a message without names.

    Raises:
        PoseFormError: the form's package is not installed.
    """
    kind = message_type(form)
    stamp = stamps.stamp_from_nanoseconds(frame.stamp)
    poses = {
        name: _pose(position, quaternion)
        for name, position, quaternion in zip(
            names, frame.positions, frame.quaternions, strict=True
        )
        if form == "pose_array" or np.isfinite(position).all()
    }
    found: dict[str, Any] = {}
    if form == "pose_stamped":
        found = {name: PoseStamped(pose=pose) for name, pose in poses.items()}
    elif form == "pose_array":
        found[""] = PoseArray(poses=list(poses.values()))
    elif form == "named_pose_array":
        named = importlib.import_module("motion_capture_tracking_interfaces.msg").NamedPose
        found[""] = kind(poses=[named(name=name, pose=pose) for name, pose in poses.items()])
    else:
        transforms = []
        for name, pose in poses.items():
            each = TransformStamped(child_frame_id=name)
            each.header.stamp, each.header.frame_id = stamp, frame_id
            each.transform.rotation, place = pose.orientation, each.transform.translation
            place.x, place.y, place.z = pose.position.x, pose.position.y, pose.position.z
            transforms.append(each)
        return {"": kind(transforms=transforms)}
    for message in found.values():
        message.header.stamp, message.header.frame_id = stamp, frame_id
    return found


def _pose(position: NDArray[np.float64], quaternion: NDArray[np.float64]) -> Pose:
    pose = Pose()
    place, turn = pose.position, pose.orientation
    place.x, place.y, place.z = map(float, position)
    turn.x, turn.y, turn.z, turn.w = map(float, quaternion)
    return pose
