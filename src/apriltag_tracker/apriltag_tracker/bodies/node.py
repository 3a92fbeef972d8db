"""The node `pose_tracker`: poses of rigid bodies in, the limb's state out."""

from __future__ import annotations

import functools
import time
from typing import Any

import numpy as np
from geometry_msgs.msg import Pose2D

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.forms import FORMS, PoseFormError, message_type, poses_of, topics_of
from apriltag_tracker.bodies.tracker import BodyNoise, BodyTracker, FrameAssembler, PoseFrame
from apriltag_tracker.pose.following import Followed
from apriltag_tracker.pose.node import LimbStateNode
from apriltag_tracker.pose.shape import FollowerOptions
from apriltag_tracker.watching import StreamWatch
from der_msgs.msg import TagDetection
from limb_interfaces import qos, stamps
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node


class PoseTrackerNode(LimbStateNode):
    """Follows the limb in poses of bodies that somebody else tracks."""

    def __init__(self) -> None:
        super().__init__("pose_tracker", "body_map", "bodies.yaml", "body")
        kinds = tuple(FORMS)
        self._form = declare(self, "form", kinds[0], "messages in which poses come", choices=kinds)
        named = "of the poses, with {body} for the name of a body; empty: that of the form"
        topic = str(declare(self, "topic", "", named))
        noise, number = BodyNoise(), functools.partial(declare, self)
        self._period = 1.0 / number("rate", 60.0, "most states a second [Hz]", 1.0, 360.0)
        noise = BodyNoise(
            number("position_sigma", noise.position, "noise of a position, m", 1e-6, 0.01),
            number("direction_sigma", noise.direction, "noise of a direction, rad", 1e-5, 0.3),
        )
        options = self.declare_following(FollowerOptions(bridge_frames=10))
        check_overrides(self)
        self._bodies = BodyMap.from_yaml(self.map_path)
        self._tracker = BodyTracker(self._bodies, options, noise)
        self._assembler = FrameAssembler(self._bodies)
        self._last = 0
        self._followed = Followed(None, "")
        self._problem = ""
        self.make_outputs(len(self._bodies.segment_lengths))
        kind, places = message_type(self._form), topics_of(self._form, topic, self._bodies.names)
        for name, place in places.items():
            take = functools.partial(self._on_message, name)
            self.create_subscription(kind, place, take, qos.POSES)
        self._first_topic = self.resolve_topic_name(next(iter(places.values())))
        self._watch = StreamWatch(self._first_topic, "frame")
        self._diagnostics = DiagnosticsPublisher(self, self._health, self._form)

    def _on_message(self, name: str, message: Any) -> None:
        now = self.get_clock().now().nanoseconds
        try:
            for body, stamp, pose in poses_of(self._form, message, name, self._bodies.names):
                for frame in self._assembler.take(body, stamp or now, pose):
                    self._on_frame(frame)
        except PoseFormError as error:
            self._problem = str(error)

    def _on_frame(self, frame: PoseFrame) -> None:
        """Follow the limb in a frame, if the last state is old enough, and publish it."""
        started = time.perf_counter()
        self._problem = ""
        self._watch.arrived(frame.stamp)
        frame = frame._replace(stamp=frame.stamp - self.sensor_delay)
        # A frame that comes somewhat early is taken: rates of others are not quite even.
        if 0 <= frame.stamp - self._last < 0.9e9 * self._period:
            return
        self._last = frame.stamp
        observation = self._tracker.observe(frame)
        followed, stamp = observation.followed, stamps.stamp_from_nanoseconds(frame.stamp)
        self._followed = followed
        latency = self.publish_state(followed.estimate, followed.reason, stamp)
        # The limb's bodies are tags without corners; the id is the place in the body map.
        places = enumerate(observation.places.tolist())
        seen = [
            TagDetection(id=k, on_limb=True, pose_valid=True, pose=Pose2D(x=x, y=y, theta=heading))
            for k, (x, y, heading) in places
            if np.isfinite(x + y + heading)
        ]
        self.publish_tags(seen, stamp)
        valid, work = followed.estimate is not None, time.perf_counter() - started
        self._watch.counted(valid, followed.bridged, latency, work)

    def _health(self) -> Health:
        tracker, unknown = self._tracker, self._assembler.unknown
        values = {
            **self._watch.values(),
            "unknown_bodies": dict(unknown),
            "bodies_misplaced": tracker.follower.misplaced,
            "base_residual_mm": f"{1e3 * tracker.base.residual:.2f}",
            **tracker.plane.values(),
        }
        if silence := self._watch.silence():
            others = f"; other bodies came: {', '.join(unknown)}" if unknown else ""
            why = "are its poses of the bodies of the body map?"
            if not self.count_publishers(self._first_topic):
                why = "nobody publishes it: start its tracker, or set the parameters form and topic"
            level, text = silence
            return Health(level, self._problem or f"{text}: {why}{others}", values)
        if error := tracker.base.problem or self._problem:
            return Health("error", error, values)
        others = self._assembler.astray.items()
        clocks = [f"stamps of {name} are {late:.2f} s off the others'" for name, late in others]
        reasons = [self._followed.reason, *clocks, self._watch.other_clock()]
        if reason := "; ".join(filter(None, reasons)):
            return Health("warning" if self._followed.estimate else "error", reason, values)
        return Health("ok", "tracking", values)


def main() -> int:
    """Run the node."""
    return run_node(PoseTrackerNode)
