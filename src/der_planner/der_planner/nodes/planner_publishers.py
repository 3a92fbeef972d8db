"""The planner's topics: plans, setpoints, tip references, estimates and markers."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PointStamped
from numpy.typing import NDArray
from rclpy.node import Node
from visualization_msgs.msg import MarkerArray

from der_msgs.msg import LimbEstimate, PressurePlan, PressureSetpoint
from der_planner.control.knowledge import Estimate
from der_planner.nodes import planner_messages
from der_planner.nodes.planner_feedback import Done
from der_planner.nodes.planner_markers import estimate_marker, limb_marker, path_markers
from der_planner.planning.streaming import GRID, Schedule
from limb_interfaces import qos, topics

Array = NDArray[np.float64]


class PlannerPublishers:
    """Publishes the plan that is being played, its setpoints, references and estimates."""

    def __init__(self, node: Node) -> None:
        self._clock = node.get_clock()
        self._plans = node.create_publisher(PressurePlan, topics.PLAN, qos.LATCHED)
        self._setpoints = node.create_publisher(
            PressureSetpoint, topics.PRESSURE_SETPOINT, qos.SETPOINT_STREAM
        )
        self._references = node.create_publisher(PointStamped, topics.TIP_REFERENCE, qos.STATES)
        self._markers = node.create_publisher(MarkerArray, topics.SHAPE_MARKERS, qos.STATES)
        self._estimates = node.create_publisher(LimbEstimate, topics.ESTIMATE, qos.STATES)

    def plan(self, schedule: Schedule) -> None:
        """Publish a whole plan, and both its tip paths as markers."""
        self._plans.publish(planner_messages.plan_message(schedule))
        self._markers.publish(path_markers(schedule.plan, self._clock.now().to_msg()))

    def setpoint(self, schedule: Schedule, index: int, pressures: Array, revision: int = 0) -> None:
        """Publish one setpoint (M,) [Pa]."""
        message = planner_messages.setpoint_message(schedule, index, pressures, revision)
        self._setpoints.publish(message)

    def reference(self, schedule: Schedule, index: int) -> None:
        """Publish where the tip should be at a setpoint's instant."""
        self._references.publish(planner_messages.reference_message(schedule, index))

    def estimate(self, schedule: Schedule, instant: int, estimate: Estimate, done: Done) -> None:
        """Publish what feedback knows of the limb at an instant [ns]."""
        message = planner_messages.estimate_message(schedule, instant, estimate)
        message.correction = done.correction.tolist()
        message.share, message.reason = done.share, done.reason
        message.solve_time = done.solve_time
        self._estimates.publish(message)
        self._markers.publish(estimate_marker(message))

    def reference_limb(self, schedule: Schedule, index: int, lead: int) -> None:
        """Draw the reference limb as it should be now, ``lead`` [ns] before setpoint ``index``."""
        index = max(0, index - 1 - lead // GRID)
        self._markers.publish(limb_marker(schedule.plan, index, self._clock.now().to_msg()))
