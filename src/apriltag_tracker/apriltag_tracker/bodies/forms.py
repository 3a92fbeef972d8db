"""The messages in which other trackers tell poses.

Two of them are in packages that not every machine has: `tf2_msgs` comes with ROS from apt,
`motion_capture_tracking_interfaces` with its own package.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any, NamedTuple

from limb_interfaces import stamps


class Form(NamedTuple):
    """A way in which poses come: type of the messages, and their topic where none is named."""

    package: str
    kind: str
    topic: str


BODY = "{body}"
"""Stands in the name of a topic for that of a body."""
FORMS = {
    "pose_stamped": Form("geometry_msgs", "PoseStamped", f"poses/{BODY}/pose"),
    "pose_array": Form("geometry_msgs", "PoseArray", "poses"),
    "tf": Form("tf2_msgs", "TFMessage", "/tf"),
    "named_pose_array": Form("motion_capture_tracking_interfaces", "NamedPoseArray", "/poses"),
}
"""Each by its name."""


class PoseFormError(RuntimeError):
    """Poses cannot come in this way; the message says what to install or to set."""


class BodyPose(NamedTuple):
    """One body: its name, stamp [ns] (0: none), and x, y, z and the quaternion x, y, z, w."""

    name: str
    stamp: int
    pose: tuple[float, ...]


def message_type(form: str) -> Any:
    """Return the type of a form's messages.

    Raises:
        PoseFormError: its package is not installed.
    """
    package, kind, _ = FORMS[form]
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except ImportError as error:
        name = f"ros-jazzy-{package.replace('_', '-')}"
        raise PoseFormError(f"form '{form}' needs the package {package}: install {name}") from error


def topics_of(form: str, topic: str, names: tuple[str, ...]) -> dict[str, str]:
    """Return the topic of each body, or of all under an empty name.

    Args:
        form: of `FORMS`.
        topic: with `BODY` for the name of a body; empty: that of the form.
        names: of the bodies.

    Raises:
        PoseFormError: each body has a topic of its own, and the name does not say where that of the
            body is to stand.
    """
    topic = topic or FORMS[form].topic
    if form != "pose_stamped":
        return {"": topic}
    if BODY not in topic and len(names) > 1:
        raise PoseFormError(f"topic '{topic}': write {BODY} where the name of a body is to stand")
    return {name: topic.replace(BODY, name) for name in names}


def poses_of(form: str, message: Any, name: str, names: tuple[str, ...]) -> Iterator[BodyPose]:
    """Yield the poses of a message.

    Args:
        form: of the message.
        message: that came.
        name: of the body whose topic it came on.
        names: of all bodies, which is the order of a message without names.

    Raises:
        PoseFormError: a message without names has another number of poses.
    """
    if form == "tf":
        for each in message.transforms:
            place, turn = each.transform.translation, each.transform.rotation
            yield BodyPose(each.child_frame_id, _stamp(each), _numbers(place, turn))
        return
    if form == "pose_stamped":
        found = [(name, message.pose)]
    elif form == "named_pose_array":
        found = [(each.name, each.pose) for each in message.poses]
    elif len(message.poses) == len(names):
        found = list(zip(names, message.poses, strict=True))
    else:
        came = f"an array of {len(message.poses)} poses came"
        raise PoseFormError(f"{came}, the body map has {len(names)} bodies")
    for each, pose in found:
        yield BodyPose(each, _stamp(message), _numbers(pose.position, pose.orientation))


def _stamp(message: Any) -> int:
    return int(stamps.nanoseconds(message.header.stamp))


def _numbers(place: Any, turn: Any) -> tuple[float, ...]:
    return (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w)
