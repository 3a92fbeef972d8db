"""Markers of the planner for RViz and Foxglove: both tip paths, and the reference limb."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from der_msgs.msg import LimbEstimate
from der_planner.planning import Plan
from limb_interfaces import topics

REFERENCE = ColorRGBA(r=0.1, g=0.6, b=0.2, a=1.0)
PREDICTED = ColorRGBA(r=0.9, g=0.5, b=0.1, a=1.0)
ESTIMATED = ColorRGBA(r=0.1, g=0.4, b=0.9, a=0.7)
LIMB = ColorRGBA(r=0.1, g=0.6, b=0.2, a=0.5)


def _line(
    name: str, points: NDArray[np.float64], color: ColorRGBA, width: float, stamp: Time
) -> Marker:
    marker = Marker(ns=f"planner/{name}", id=0, type=Marker.LINE_STRIP, action=Marker.ADD)
    marker.header.frame_id = topics.BASE_FRAME
    marker.header.stamp = stamp
    marker.pose.orientation.w = 1.0
    marker.scale.x = width
    marker.color = color
    marker.points = [Point(x=float(x), y=float(y)) for x, y in points]
    return marker


def path_markers(plan: Plan, stamp: Time) -> MarkerArray:
    """Return the reference and the predicted path of the tip."""
    return MarkerArray(
        markers=[
            _line("reference_path", plan.tip_reference, REFERENCE, 0.001, stamp),
            _line("predicted_path", plan.tip_predicted, PREDICTED, 0.0007, stamp),
        ]
    )


def limb_marker(plan: Plan, index: int, stamp: Time) -> MarkerArray:
    """Return the centreline of the model's reference configuration at a setpoint."""
    return MarkerArray(markers=[_line("limb", plan.curve(index), LIMB, 0.006, stamp)])


def estimate_marker(message: LimbEstimate) -> MarkerArray:
    """Return the centreline of the estimated limb."""
    points = np.array([(point.x, point.y) for point in message.curve])
    return MarkerArray(markers=[_line("estimate", points, ESTIMATED, 0.004, message.header.stamp)])
