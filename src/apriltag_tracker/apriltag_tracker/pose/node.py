"""What the two trackers' nodes share: parameters, and the limb's state out."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from ament_index_python.packages import get_package_share_directory
from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from rclpy.qos import QoSProfile
from visualization_msgs.msg import MarkerArray

from apriltag_tracker.pose.following import FollowerOptions
from apriltag_tracker.pose.shape import LimbEstimate
from apriltag_tracker.state_messages import (
    limb_markers,
    limb_state,
    limb_transforms,
    transforms_type,
)
from der_msgs.msg import LimbState, TagDetection, TagDetectionArray
from limb_interfaces import qos, stamps, topics
from limb_interfaces.parameters import declare

TF = "/tf"
_MARKER_PERIOD = 0.1
_Options = TypeVar("_Options", bound=FollowerOptions)


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
        share = Path(get_package_share_directory("apriltag_tracker")) / "config" / map_file
        where = f"YAML file: which {noun} is where"
        self.map_path = str(declare(self, map_parameter, str(share), where))
        late = "from an exposure to its stamp [s]"
        self.sensor_delay = round(1e9 * self.number("sensor_delay", 0.0, late, -0.5, 0.5))
        """To be taken off stamps [ns]."""
        self._noun = noun
        self._last_markers = 0.0

    def number(
        self, name: str, default: float, description: str, at_least: float, at_most: float
    ) -> float:
        """Declare a number; one whose default is whole is whole."""
        return declare(self, name, default, description, at_least=at_least, at_most=at_most)

    def declare_following(self, usual: _Options) -> _Options:
        """Declare how the limb is followed; ``usual`` are the defaults."""
        noun, sigma, number = self._noun, usual.uncertainty, self.number
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
            bridge_frames=int(number("bridge_frames", usual.bridge_frames, missing, 0, 100)),
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
        kind = transforms_type()
        # The depth is that of tf2_ros.
        self._transforms = kind and self.create_publisher(kind, TF, QoSProfile(depth=100))

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
