"""The node `synthetic_poses`: what motion capture would tell of the limb's twin."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from ament_index_python.packages import get_package_share_directory
from rclpy.node import Node

from apriltag_tracker.bodies.body_map import BodyMap
from apriltag_tracker.bodies.forms import FORMS, message_type, pose_messages, topics_of
from apriltag_tracker.synthetic.poses import MocapFaults, SyntheticMocap
from apriltag_tracker.synthetic.shapes import Shape
from der_msgs.msg import LimbShape
from limb_interfaces import qos, stamps, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node

_FRAME = "mocap"


class SyntheticPosesNode(Node):
    """Subscribes to the twin's shape and publishes the poses of the bodies on it."""

    def __init__(self) -> None:
        super().__init__("synthetic_poses", namespace=topics.NAMESPACE)
        share = Path(get_package_share_directory("apriltag_tracker")) / "config"
        body_map = declare(
            self, "body_map", str(share / "bodies.yaml"), "YAML file: where the bodies are"
        )
        form = declare(self, "form", FORMS[0], "messages in which poses go", choices=FORMS)
        topic = declare(self, "topic", "", "of the poses; empty: that of the form")
        seed = declare(self, "seed", 0, "of noise and dropouts", at_least=0)
        number = self._number
        swapped = declare(self, "swapped", "", "two bodies with each other's names: NAME,NAME")
        faults = MocapFaults(
            position_noise=number("position_noise", 1e-4, "of a coordinate [m]", 0.0, 0.01),
            direction_noise=number("direction_noise", 2e-3, "of a turn [rad]", 0.0, 0.3),
            dropout=number("dropout", 0.0, "share of frames without a body", 0.0, 1.0),
            swapped=tuple(name.strip() for name in str(swapped).split(",") if name.strip()),
            swapped_from=number("swapped_from", 0.0, "[s] since the first frame", 0.0, 1e6),
            swapped_until=number("swapped_until", 1e6, "[s] since the first frame", 0.0, 1e6),
            delay=number("delay", 0.0, "by which stamps are late [s]", -0.5, 0.5),
        )
        turn = number("turn", 0.3, "of limb_base in the frame of the poses [rad]", -4.0, 4.0)
        tilt = number("tilt", 0.0, "of the plane of motion against the floor [rad]", -2.0, 2.0)
        check_overrides(self)
        self._form = str(form)
        bodies = BodyMap.from_yaml(str(body_map))
        self._mocap = SyntheticMocap(bodies, faults, turn, tilt, int(seed))
        kind = message_type(self._form)
        self._outputs: dict[str, Any] = {
            name: self.create_publisher(kind, place, qos.STATES)
            for name, place in topics_of(self._form, str(topic), bodies.names).items()
        }
        self._frames = self._refused = 0
        self._last_shape = time.monotonic()
        self.create_subscription(LimbShape, topics.TWIN_SHAPE, self._on_shape, qos.STATES)
        self._diagnostics = DiagnosticsPublisher(self, self._health, "simulated")

    def _number(
        self, name: str, default: float, description: str, at_least: float, at_most: float
    ) -> float:
        return float(declare(self, name, default, description, at_least=at_least, at_most=at_most))

    def _on_shape(self, message: LimbShape) -> None:
        self._last_shape = time.monotonic()
        points = np.array([(point.x, point.y) for point in message.points]).reshape(-1, 2)
        shape = Shape(np.array(message.arc_length), points, np.array(message.heading))
        count = len(points)
        if count < 2 or not count == len(shape.arc_length) == len(shape.heading):
            self._refused += 1
            return
        frame = self._mocap.frame(stamps.nanoseconds(message.header.stamp), shape)
        found = pose_messages(self._form, self._mocap.bodies.names, frame, _FRAME)
        for name, each in found.items():
            self._outputs[name].publish(each)
        self._frames += 1

    def _health(self) -> Health:
        values = {"frames": self._frames, "refused_shapes": self._refused}
        silent = time.monotonic() - self._last_shape
        if self._frames == 0:
            return Health("stale", f"waiting for shapes on {topics.TWIN_SHAPE}", values)
        if silent > 1.0:
            said = f"no shape on {topics.TWIN_SHAPE} for {silent:.0f} s: is limb_twin running?"
            return Health("warning", said, values)
        return Health("ok", "telling poses", values)


def main() -> int:
    """Run the node."""
    return run_node(SyntheticPosesNode)


if __name__ == "__main__":
    sys.exit(main())
