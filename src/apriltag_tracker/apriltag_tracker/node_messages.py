"""What the node says, as messages: tags, and the limb for RViz and Foxglove."""

from __future__ import annotations

from geometry_msgs.msg import Pose2D
from visualization_msgs.msg import Marker, MarkerArray

from apriltag_tracker.pipeline import PlacedTag
from der_msgs.msg import LimbState, TagDetection


def tag_message(placed: PlacedTag) -> TagDetection:
    """Return a tag with its place, if the camera's is known."""
    tag = placed.tag
    message = TagDetection(
        id=tag.id,
        corners=tag.corners.ravel(),
        on_limb=placed.on_limb,
        pose_valid=placed.pose is not None,
        pixel_size=tag.pixel_size,
        line_residual=tag.line_residual,
    )
    if placed.pose is not None:
        x, y, yaw = placed.pose.tolist()
        message.pose = Pose2D(x=x, y=y, theta=yaw)
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
