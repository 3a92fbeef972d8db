"""Nodes that show the shape of the twin. They share that they listen to it, and say how it goes."""

from __future__ import annotations

import time
from abc import abstractmethod

import numpy as np
from rclpy.node import Node
from rclpy.qos import QoSProfile

from apriltag_tracker.synthetic.shapes import Shape
from der_msgs.msg import LimbShape
from limb_interfaces import stamps, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health


class ShapeListener(Node):
    """Takes the shapes of the twin.

    Args:
        name: of the node.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name, namespace=topics.NAMESPACE)
        self._frames = 0
        self._last_shape = time.monotonic()
        self._busy = 0.0

    def listen(self, hardware: str, profile: QoSProfile) -> None:
        """Begin, once everything is ready; ``hardware`` names in the diagnostics what it is."""
        self.create_subscription(LimbShape, topics.TWIN_SHAPE, self._on_shape, profile)
        self._diagnostics = DiagnosticsPublisher(self, self._health, hardware)

    @abstractmethod
    def show(self, stamp: int, shape: Shape) -> None:
        """Publish what is to be seen of a shape at an instant [ns]."""

    def _on_shape(self, message: LimbShape) -> None:
        started = time.perf_counter()
        self._last_shape = time.monotonic()
        points = np.array([(point.x, point.y) for point in message.points])
        shape = Shape(np.array(message.arc_length), points, np.array(message.heading))
        self.show(stamps.nanoseconds(message.header.stamp), shape)
        self._frames += 1
        self._busy += time.perf_counter() - started

    def _health(self) -> Health:
        silent = time.monotonic() - self._last_shape
        values = {
            "frames": self._frames,
            "render_ms": f"{1e3 * self._busy / max(self._frames, 1):.2f}",
        }
        if self._frames == 0:
            return Health("stale", f"waiting for shapes on {topics.TWIN_SHAPE}", values)
        if silent > 1.0:
            said = f"no shape on {topics.TWIN_SHAPE} for {silent:.0f} s: is limb_twin running?"
            return Health("warning", said, values)
        return Health("ok", "rendering", values)
