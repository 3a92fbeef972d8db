"""The node `pose_tracker`: poses of rigid bodies in, the limb's state out."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from ament_index_python.packages import get_package_share_directory
from geometry_msgs.msg import Pose2D
from rclpy.node import Node

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.forms import FORMS, PoseSubscriber
from apriltag_tracker.bodies.tracker import BodyNoise, BodyObservation, BodyTracker, PoseFrame
from apriltag_tracker.pose.following import FollowerOptions, Uncertainty
from apriltag_tracker.publishing import StatePublisher
from apriltag_tracker.watching import StampGaps, StreamWatch
from der_msgs.msg import TagDetection, TagDetectionArray
from limb_interfaces import qos, stamps, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node


class PoseTrackerNode(Node):
    """Follows the limb in poses of bodies that somebody else tracks."""

    def __init__(self) -> None:
        super().__init__("pose_tracker", namespace=topics.NAMESPACE)
        share = Path(get_package_share_directory("apriltag_tracker")) / "config"
        body_map = declare(
            self, "body_map", str(share / "bodies.yaml"), "YAML file: where the bodies are"
        )
        form = declare(self, "form", FORMS[0], "messages in which poses come", choices=FORMS)
        topic = declare(
            self,
            "topic",
            "",
            "of the poses, with {body} for the name of a body; empty: that of the form",
        )
        number = self._number
        self._period = 1.0 / number("rate", 60.0, "most states a second [Hz]", 1.0, 360.0)
        self._delay = round(
            1e9 * number("sensor_delay", 0.0, "from an exposure to its stamp [s]", -0.5, 0.5)
        )
        options, noise = self._declare_options()
        check_overrides(self)
        bodies = BodyMap.from_yaml(str(body_map))
        self._tracker = BodyTracker(bodies, options, noise)
        self._gaps = StampGaps()
        self._last = 0
        self._reason = ""
        self._states = StatePublisher(self, len(bodies.segment_lengths))
        self._tags = self.create_publisher(TagDetectionArray, topics.TAGS, qos.STATES)
        self._poses = PoseSubscriber(self, str(form), str(topic), bodies, self._on_frame)
        self._first_topic = self.resolve_topic_name(next(iter(self._poses.topics.values())))
        self._watch = StreamWatch(self._first_topic, "frame")
        self._diagnostics = DiagnosticsPublisher(self, self._health, str(form))

    def _number(
        self, name: str, default: float, description: str, at_least: float, at_most: float
    ) -> float:
        return declare(self, name, default, description, at_least=at_least, at_most=at_most)

    def _declare_options(self) -> tuple[FollowerOptions, BodyNoise]:
        usual, noise, number = FollowerOptions(), BodyNoise(), self._number
        sigma = usual.uncertainty
        bridged = "frames without limb bodies that are bridged and marked"
        apart = "distance in m from the other bodies' shape at which a body is left out"
        unsure = "standard deviation of the tip in m above which no tip is told"
        options = FollowerOptions(
            bridge_frames=int(number("bridge_frames", 10, bridged, 0, 100)),
            reject_beyond=number("reject_beyond", usual.reject_beyond, apart, 0.0, 0.1),
            largest_tip_sigma=number(
                "largest_tip_sigma", usual.largest_tip_sigma, unsure, 0.0, 1.0
            ),
            uncertainty=Uncertainty(
                survey=number("survey_sigma", sigma.survey, "of fixed bodies' places, m", 0.0, 0.1),
                mounting=number(
                    "mounting_sigma", sigma.mounting, "of limb bodies on the limb, m", 0.0, 0.1
                ),
                mounting_angle=number(
                    "mounting_angle_sigma",
                    sigma.mounting_angle,
                    "of limb bodies' directions, rad",
                    0.0,
                    1.0,
                ),
            ),
        )
        of_places, of_turns = "noise of a body's position, m", "noise of its direction, rad"
        return options, BodyNoise(
            number("position_sigma", noise.position, of_places, 1e-6, 0.01),
            number("direction_sigma", noise.direction, of_turns, 1e-5, 0.3),
        )

    def _on_frame(self, frame: PoseFrame) -> None:
        """Follow the limb in a frame, if the last state is old enough, and publish it."""
        started = time.perf_counter()
        self._watch.arrived()
        self._gaps.take(frame.stamp)
        frame = frame._replace(stamp=frame.stamp - self._delay)
        # A frame that comes somewhat early is taken: rates of others are not quite even.
        if 0 <= frame.stamp - self._last < 0.9e9 * self._period:
            return
        self._last = frame.stamp
        observation = self._tracker.observe(frame)
        followed, stamp = observation.followed, stamps.stamp_from_nanoseconds(frame.stamp)
        self._reason = followed.reason
        latency = self._states.publish(followed.estimate, followed.reason, stamp)
        tags = TagDetectionArray(detections=_detections(observation))
        tags.header.stamp, tags.header.frame_id = stamp, topics.BASE_FRAME
        self._tags.publish(tags)
        self._watch.counted(
            followed.estimate is not None,
            followed.bridged,
            latency,
            time.perf_counter() - started,
        )

    def _health(self) -> Health:
        tracker, assembler = self._tracker, self._poses.assembler
        values = {
            **self._watch.values(),
            "frames_missed": self._gaps.missed,
            "unknown_bodies": dict(assembler.unknown),
            "bodies_misplaced": tracker.follower.misplaced,
            "bodies_swapped": tracker.swapped,
            "base_residual_mm": f"{1e3 * tracker.base.residual:.2f}",
            "base_bumps": tracker.base.bumps,
            **tracker.plane.values(),
        }
        if silence := self._watch.silence():
            publishers = self.count_publishers(self._first_topic)
            why = (
                "it has a publisher: are its poses of the bodies of the body map?"
                if publishers
                else "nobody publishes it; start the tracker of the bodies, or set the parameters "
                "form and topic"
            )
            others = f"; other bodies came: {', '.join(assembler.unknown)}"
            text = f"{silence}: {why}{others if assembler.unknown else ''}"
            return Health(self._watch.silence_level, self._poses.wrong_size or text, values)
        if tracker.base.problem:
            return Health("error", tracker.base.problem, values)
        if self._poses.wrong_size:
            return Health("error", self._poses.wrong_size, values)
        if tracker.base.bumps:
            said = f"fixed bodies were moved {tracker.base.bumps} time(s); the base was found again"
            return Health("warning", said, values)
        if self._reason:
            return Health("warning", self._reason, values)
        return Health("ok", "tracking", values)


def _detections(observation: BodyObservation) -> list[TagDetection]:
    """Return the limb's bodies as tags without corners; the id is the place in the body map."""
    return [
        TagDetection(
            id=k, on_limb=True, pose_valid=True, pose=Pose2D(x=place[0], y=place[1], theta=place[2])
        )
        for k, place in enumerate(observation.places.tolist())
        if np.isfinite(place).all()
    ]


def main() -> int:
    """Run the node."""
    return run_node(PoseTrackerNode)


if __name__ == "__main__":
    sys.exit(main())
