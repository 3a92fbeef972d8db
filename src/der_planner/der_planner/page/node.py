"""The page as a ROS node: topics in, services and motion commands out."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rcl_interfaces.msg import Log
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import MarkerArray

from apriltag_tracker.camera import Intrinsics
from apriltag_tracker.camera.images import ImageReader
from apriltag_tracker.detection import Tag
from apriltag_tracker.installed import CONFIG
from apriltag_tracker.tag_map import TagMap
from der_msgs.msg import (
    LimbContact,
    LimbEstimate,
    LimbState,
    OperatorLease,
    PressurePlan,
    PressureState,
    TagDetectionArray,
)
from der_planner.arrays import points_of
from der_planner.limb import Limb, LimbError, Load
from der_planner.page.access import Binding, Desk
from der_planner.page.commands import Commands
from der_planner.page.drawing import DrawingFolder, Previewer
from der_planner.page.picture import Overlay, PictureFeed
from der_planner.page.server import PageServer, Parts
from der_planner.page.situation import Situation
from der_planner.page.window import lay_out
from der_planner.planning import PathLimits
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.parameters import check_overrides, declare
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import nanoseconds

LIMB_MARKER = "planner/limb"
ROSOUT = "/rosout"
LEASE_LOOK = 0.2
"""Time between two promises to the driver [s]."""


class PageNode(Node):
    """Serves the operator's page; it commands through the services that a terminal would use."""

    def __init__(self) -> None:
        super().__init__("page", namespace=topics.NAMESPACE)
        self.fatal_error = ""
        self._refused = 0
        self._last_refused = ""
        read: Callable[..., Any] = functools.partial(declare, self)
        binding = self._read_binding(read)
        previewer = self._read_previewer(read)
        report = read("report", "", "folder of an experiment's report, shown once it is there")
        drawings = read("drawings", "~/limb_drawings", "folder of kept drawings")
        tag_map = read("tag_map", str(CONFIG / "tags.yaml"), "YAML file: where the tags are")
        rate = read("picture_rate", 15.0, "pictures a second at most [Hz]", 1.0, 30.0)
        lost = (
            "the driver does as its `on_lost_operator` says when the operator's browser has been "
            "silent for this time [s]; 0: it is never told"
        )
        # At most less than the desk is kept, which would give the lease up.
        self._lease_period: float = read("lease_period", 2.0, lost, 0.0, 10.0)
        self._leased = False
        # A misspelt name of a protection must not leave the page without it.
        check_overrides(self)
        self._situation = Situation(namespace=self.get_namespace())
        self._parts = Parts(
            situation=self._situation,
            picture=PictureFeed(rate),
            overlay=Overlay(TagMap.from_yaml(tag_map)),
            desk=Desk(),
            commands=Commands(self, self._situation),
            previewer=previewer,
            drawings=DrawingFolder(Path(drawings).expanduser()),
            report=Path(report).absolute() if report else None,
        )
        self._picture, self._overlay = self._parts.picture, self._parts.overlay
        self._server = PageServer(binding, self._parts, lay_out)
        self._images: Subscription | None = None
        self._subscribe_all()
        self._diagnostics = DiagnosticsPublisher(self, self._health)
        self._leases = self.create_publisher(OperatorLease, topics.OPERATOR_LEASE, qos.LEASES)
        self.create_timer(0.2, self._watch)
        self.create_timer(LEASE_LOOK, self._renew_lease)
        self._server.start()
        self.get_logger().info(f"the page is at {self._server.url}?token={binding.token}")
        if not binding.loopback:
            self.get_logger().warning(
                f"other machines reach {binding.address}, and the token travels in the clear: an "
                "SSH tunnel to 127.0.0.1 hides it"
            )

    def _read_binding(self, read: Callable[..., Any]) -> Binding:
        token = read("token", "", "secret that opens the page; empty: one drawn at random")
        names = read("host_names", [""], "further names by which browsers reach the page")
        return Binding(
            address=read("address", "127.0.0.1", "IP address to listen on"),
            port=read("port", 8080, "TCP port; 0: any free one", at_least=0, at_most=65535),
            host_names=tuple(name for name in names if name),
            **({"token": token} if token else {}),
        )

    def _read_previewer(self, read: Callable[..., Any]) -> Previewer:
        planned = "the planner's limb file until it is heard; empty: the default limb"
        limb_file = read("limb_file", "", planned)
        self._mounting: str = read("mounting", "", "as the planner's; empty: as in the limb file")
        payload = read("payload", 0.0, "as the planner's [kg]", at_least=0.0)
        place = read("payload_at", 0.0, "as the planner's [m]; 0: the tip", at_least=0.0)
        speed = read("path_speed", 0.03, "as the planner's [m/s]", at_least=1e-3)
        most = read("path_acceleration", 0.05, "as the planner's [m/s^2]", at_least=1e-3)
        return Previewer(self._read_limb(limb_file), PathLimits(speed, most), Load(payload, place))

    def _read_limb(self, file: str) -> Limb:
        self._limb_file = file
        limb = Limb.from_yaml(file) if file else Limb.default()
        return limb.loaded(Load(mounting=self._mounting))

    # What comes in -------------------------------------------------------------------------

    def _subscribe_all(self) -> None:
        subscribe, situation = self._subscribe, self._situation
        subscribe(PressureState, topics.PRESSURE_STATE, situation.put_driver, qos.STATES)
        subscribe(LimbState, topics.LIMB_STATE, self._on_limb, qos.STATES)
        subscribe(TagDetectionArray, topics.TAGS, self._on_tags, qos.STATES)
        subscribe(PointStamped, topics.TIP_REFERENCE, self._on_reference, qos.STATES)
        subscribe(PressurePlan, topics.PLAN, self._on_plan, qos.LATCHED)
        subscribe(MarkerArray, topics.SHAPE_MARKERS, self._on_markers, qos.STATES)
        subscribe(CameraInfo, topics.CAMERA_INFO, self._on_camera, qos.LATCHED)
        subscribe(CameraInfo, topics.CAMERA_INFO, self._on_camera, qos.IMAGES)
        subscribe(LimbEstimate, topics.ESTIMATE, self._on_estimate, qos.STATES)
        subscribe(LimbContact, topics.CONTACT, situation.put_contact, qos.STATES)
        subscribe(Log, ROSOUT, situation.put_log, qos.STATES)
        subscribe(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, qos.STATES)

    def _subscribe(
        self,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        profile: QoSProfile,
        raw: bool = False,
    ) -> Subscription:
        """Subscribe; a message that the callback cannot take is reported and left out.

        A message of another program may make no sense: it must not end the page and its vent.
        """

        def take(message: Any) -> None:
            try:
                callback(message)
            except Exception as error:  # whatever is wrong with the message
                self._refused += 1
                self._last_refused = f"a message of {topic} could not be used: {error}"
                self.get_logger().error(self._last_refused, throttle_duration_sec=10.0)

        # Of the two subscriptions to the calibration, one is always told that its QoS does not fit.
        no_warnings = SubscriptionEventCallbacks(use_default_callbacks=False)
        return self.create_subscription(
            kind, topic, take, profile, event_callbacks=no_warnings, raw=raw
        )

    def _on_limb(self, message: LimbState) -> None:
        self._situation.put_limb(message)
        curve = points_of(message.curve if message.valid else [])
        tip = points_of([message.tip] if message.valid else [])
        self._overlay.put_limb(nanoseconds(message.header.stamp), curve, tip)

    def _on_tags(self, message: TagDetectionArray) -> None:
        tags = [
            Tag(tag.id, np.array(tag.corners).reshape(4, 2), np.zeros((8, 8)), 0.0)
            for tag in message.detections
        ]
        self._overlay.put_tags(nanoseconds(message.header.stamp), tags)

    def _on_reference(self, message: PointStamped) -> None:
        stamp = nanoseconds(message.header.stamp)
        self._situation.put_reference(stamp, message.point.x, message.point.y)

    def _on_plan(self, message: PressurePlan) -> None:
        self._overlay.put_path(np.array(message.tip_reference).reshape(-1, 2))
        self._situation.put_plan(message)

    def _on_estimate(self, message: LimbEstimate) -> None:
        self._situation.put_estimate(message)
        self._overlay.put_shape("estimate", points_of(message.curve))

    def _on_markers(self, message: MarkerArray) -> None:
        for marker in message.markers:
            if marker.ns == LIMB_MARKER:
                self._overlay.put_shape("planned", points_of(marker.points))

    def _on_camera(self, message: CameraInfo) -> None:
        self._overlay.put_camera(
            Intrinsics.create(
                message.width, message.height, message.k, message.d, message.distortion_model
            )
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self._situation.put_status(status)

    def _on_image(self, data: bytes) -> None:
        """Take an image as bytes: most are thrown away without being unpacked."""
        self._situation.hear("camera")
        if not self._picture.due():
            return
        message = deserialize_message(data, Image)
        self._picture.put(nanoseconds(message.header.stamp), ImageReader().to_grey(message))

    def _watch(self) -> None:
        """Draw with the planner's limb, take images while somebody looks, end with the server."""
        file = self._situation.value_of("planner", "limb_file")
        if file not in ("", self._limb_file):
            try:
                self._parts.previewer.follow(self._read_limb(file))
            except LimbError as error:  # as on another computer
                self.get_logger().warning(f"drawings are not planned as the planner does: {error}")
        if self._server.error is not None:
            self.fatal_error = f"the page's server ended: {self._server.error}"
        if self._picture.watched and self._images is None:
            self._images = self._subscribe(
                Image, topics.IMAGE, self._on_image, qos.IMAGES, raw=True
            )
        elif not self._picture.watched and self._images is not None:
            self.destroy_subscription(self._images)
            self._images = None

    def _renew_lease(self) -> None:
        """Promise the driver that the operator watches on; each promise ends with the browser's.

        Nothing is promised that the browser has not answered for: whatever dies on the way from
        there to here, or the page itself, the driver hears of no operator any more.
        """
        silence = self._parts.desk.silence
        if silence is None and self._leased:
            self._leases.publish(OperatorLease(source=self._server.url))  # given up on purpose
        left = -1.0 if silence is None else self._lease_period - silence
        if left > 0.0:
            self._leases.publish(OperatorLease(source=self._server.url, period=left))
        self._leased = silence is not None and self._lease_period > 0.0

    # What it says of itself ----------------------------------------------------------------

    def _health(self) -> Health:
        values = {
            "url": self._server.url,
            "operator": "yes" if self._parts.desk.operator else "no",
            "limb": self._parts.previewer.limb.name,
            "picture": "watched" if self._picture.watched else "nobody looks",
            "refused_requests": self._server.access.refused,
            "refused_messages": self._refused,
            "lease_period_s": self._lease_period,
            "threads": threading.active_count(),
        }
        if not self._server.ready:
            return Health("stale", "the server is starting", values)
        if self._refused:
            return Health("warning", self._last_refused, values)
        return Health("ok", f"serving {self._server.url}", values)

    def close(self) -> None:
        """Stop serving."""
        self._server.close()
        self._parts.previewer.close()


def create_executor() -> Executor:
    """Return what spins the page.

    rclpy's ordinary executor gathers all that it waits for anew after each message, which costs
    this node more than the messages do; rclpy has no other one before version 7.1.5.
    """
    try:
        from rclpy.experimental import EventsExecutor  # noqa: PLC0415 - it may be missing
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def main() -> int:
    """Run the node."""
    cv2.setNumThreads(1)
    return run_node(PageNode, create_executor=create_executor)
