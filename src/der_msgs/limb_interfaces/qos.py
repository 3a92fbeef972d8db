"""The QoS profiles of the graph, in one place and by the role of the topic.

A profile of a depth alone keeps that many messages and is reliable.
"""

from rclpy.duration import Duration
from rclpy.qos import (
    DurabilityPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
    qos_profile_sensor_data,
)

COMMANDS = QoSProfile(depth=10)
"""Motion commands and paths: none may be lost, and none may reach a node that starts later."""

SETPOINTS = QoSProfile(depth=100)
"""Timed setpoints: deep enough for five seconds at 20 Hz."""

SETPOINT_STREAM = QoSProfile(
    depth=100,
    deadline=Duration(seconds=0.2),
    liveliness=LivelinessPolicy.AUTOMATIC,
    liveliness_lease_duration=Duration(seconds=1),
)
"""What the planner offers on the setpoints' topic: while a plan is played the next one comes within
four ticks, and a publisher that has died is known to be gone after a second. It is only offered: a
subscriber that requested it would match no publisher of plain QoS, such as ``ros2 topic pub``."""

STATES = QoSProfile(depth=20)
"""Measured and published states, tags and references."""

LATCHED = QoSProfile(
    depth=1,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The last one is kept for those who come later: plans, calibration."""

CLOCKS = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Questions for the time: one that comes late because it was sent again says nothing."""

IMAGES = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A subscriber of images takes the newest and never queues."""

SENSOR_DATA = qos_profile_sensor_data
"""A publisher of images and camera calibration."""

POSES = QoSProfile(depth=20, reliability=ReliabilityPolicy.BEST_EFFORT)
"""A subscriber of poses hears all publishers, and all bodies of a frame that come at once; more
would be frames of the past for a tracker that is too slow."""

LEASES = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Signs of an operator: one that a network held up must not come later in place of a newer one."""


def profile(depth: int, reliable: bool, kept: bool) -> QoSProfile:
    """Return the profile of a recorded topic.

    Args:
        depth: messages that may wait.
        reliable: what is lost on the way is sent again.
        kept: the last messages are there for those who come later.
    """
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    durability = DurabilityPolicy.TRANSIENT_LOCAL if kept else DurabilityPolicy.VOLATILE
    return QoSProfile(depth=depth, reliability=reliability, durability=durability)
