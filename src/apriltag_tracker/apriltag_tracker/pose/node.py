"""What the two trackers' nodes share: parameters, and the limb's state out.

It goes out as `state`, as markers for RViz and Foxglove, and as transforms for RViz.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile
from scipy.spatial.transform import Rotation
from visualization_msgs.msg import Marker, MarkerArray

from apriltag_tracker.bodies.forms import FORMS, PoseFormError, message_type
from apriltag_tracker.installed import CONFIG
from apriltag_tracker.pose.shape import FollowerOptions, LimbEstimate
from der_msgs.msg import LimbState, TagDetection, TagDetectionArray
from limb_interfaces import qos, stamps, topics
from limb_interfaces.parameters import declare

CLAMP_FRAME = "limb_clamp"
"""Name of the frame at the clamped end, which is the origin of `limb_base`."""
TIP_FRAME = "limb_tip"
"""Name of the frame at the tip, x along the limb."""
_MARKER_PERIOD = 0.1


class LimbStateNode(Node):
    """Tells where the limb is.

    Args:
        name: of the node.
        map_parameter: name of the parameter with the file that says what is where on the limb.
        map_file: file in the package's configuration that it is by default.
        noun: what is seen of the limb: ``tag`` or ``body``, for descriptions.
    """

    def __init__(self, name: str, map_parameter: str, map_file: str, noun: str) -> None:
        super().__init__(name, namespace=topics.NAMESPACE)
        where = f"YAML file: which {noun} is where"
        self.map_path = str(declare(self, map_parameter, str(CONFIG / map_file), where))
        late = "from an exposure to its stamp [s]"
        self.sensor_delay = round(1e9 * declare(self, "sensor_delay", 0.0, late, -0.5, 0.5))
        """To be taken off stamps [ns]."""
        self._noun = noun
        self._last_markers = 0.0

    def declare_following(self, usual: FollowerOptions) -> FollowerOptions:
        """Declare how the limb is followed; ``usual`` are the defaults."""
        noun, sigma, number = self._noun, usual.uncertainty, functools.partial(declare, self)
        missing = f"frames without limb {noun} that are bridged and marked"
        apart = f"distance in m from the others' shape at which a {noun} is left out"
        unsure = "standard deviation of the tip in m above which no tip is told"
        surveyed, placed = f"of each fixed {noun}'s place, m", f"of each limb {noun}'s place, m"
        turned = f"of each limb {noun}'s direction, rad"
        uncertainty = dataclasses.replace(
            sigma,
            survey=number("survey_sigma", sigma.survey, surveyed, 0.0, 0.1),
            mounting=number("mounting_sigma", sigma.mounting, placed, 0.0, 0.1),
            mounting_angle=number("mounting_angle_sigma", sigma.mounting_angle, turned, 0.0, 1.0),
        )
        return dataclasses.replace(
            usual,
            bridge_frames=number("bridge_frames", usual.bridge_frames, missing, 0, 100),
            reject_beyond=number("reject_beyond", usual.reject_beyond, apart, 0.0, 0.1),
            largest_tip_sigma=number(
                "largest_tip_sigma", usual.largest_tip_sigma, unsure, 0.0, 1.0
            ),
            uncertainty=uncertainty,
        )

    def make_outputs(self, segment_count: int) -> None:
        """Make the publishers of a limb with M segments."""
        self._segment_count = segment_count
        self._states = self.create_publisher(LimbState, topics.LIMB_STATE, qos.STATES)
        self._tags = self.create_publisher(TagDetectionArray, topics.TAGS, qos.STATES)
        self._markers = self.create_publisher(MarkerArray, topics.SHAPE_MARKERS, qos.STATES)
        self._transforms: Any = None
        # ROS from apt has `tf2_msgs`, its wheels have not; without it nothing else changes.
        with contextlib.suppress(PoseFormError):
            # The depth is that of tf2_ros.
            kind, depth = message_type("tf"), QoSProfile(depth=100)
            self._transforms = self.create_publisher(kind, FORMS["tf"].topic, depth)

    def publish_state(
        self,
        estimate: LimbEstimate | None,
        reason: str,
        stamp: Time,
        transforms: Iterable[TransformStamped] = (),
    ) -> float:
        """Publish a state, and what is drawn of it.

        Args:
            estimate: the limb; None if it cannot be told.
            reason: why not, or what was bridged or left out.
            stamp: when it was so.
            transforms: further ones of the same instant.

        Returns:
            Latency of the state [s].
        """
        state = limb_state(estimate, reason, stamp, self._segment_count)
        late = self.get_clock().now().nanoseconds - stamps.nanoseconds(stamp)
        state.latency = late / stamps.NANOSECONDS
        self._states.publish(state)
        if self._transforms is not None:
            found = limb_transforms(estimate.curve, stamp) if estimate is not None else []
            if found := [*found, *transforms]:
                self._transforms.publish(self._transforms.msg_type(transforms=found))
        now = time.monotonic()
        if (
            estimate is not None
            and now - self._last_markers >= _MARKER_PERIOD
            and self._markers.get_subscription_count() > 0
        ):
            self._last_markers = now
            self._markers.publish(limb_markers(state))
        return late / stamps.NANOSECONDS

    def publish_tags(self, detections: list[TagDetection], stamp: Time) -> None:
        """Publish what was seen."""
        tags = TagDetectionArray(detections=detections)
        tags.header.stamp = stamp
        tags.header.frame_id = topics.BASE_FRAME
        self._tags.publish(tags)


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
        message.bend_angle = message.bend_angle_sigma = message.curvature = [nan] * segment_count
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
