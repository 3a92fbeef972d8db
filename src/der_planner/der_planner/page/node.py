"""The page as a ROS node: topics in, services and motion commands out."""

from __future__ import annotations

import functools
import sys
import threading
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from ament_index_python.packages import get_package_share_directory
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Image
from visualization_msgs.msg import MarkerArray

from apriltag_tracker.camera import CameraError, Intrinsics
from apriltag_tracker.camera.images import ImageError, to_grey
from apriltag_tracker.detection import Tag
from apriltag_tracker.tag_map import TagMap
from der_msgs.msg import (
    LimbEstimate,
    LimbState,
    PressurePlan,
    PressureState,
    TagDetectionArray,
)
from der_planner.limb import Limb, mounting_of
from der_planner.page.access import Binding, listen, read_password
from der_planner.page.afterwards.experiments import Experiments
from der_planner.page.commands import Load
from der_planner.page.drawing.studio import Studio
from der_planner.page.graph_commands import GraphCommands
from der_planner.page.intake import Intake
from der_planner.page.layout import lay_out
from der_planner.page.operators import POLICIES, Desk
from der_planner.page.overlay import Overlay
from der_planner.page.picture import PictureFeed
from der_planner.page.server import PageServer, Parts
from der_planner.page.situation import (
    DriverState,
    EstimateView,
    LimbView,
    NodeStatus,
    PlanView,
    Situation,
)
from der_planner.page.worker import Worker
from der_planner.planning import PathLimits
from limb_interfaces import qos, topics
from limb_interfaces.diagnostics import DiagnosticsPublisher, Health
from limb_interfaces.overrides import check_overrides
from limb_interfaces.parameters import declare
from limb_interfaces.runner import run_node
from limb_interfaces.stamps import nanoseconds

LIMB_MARKER = "planner/limb"


class PageNode(Node):
    """Serves the operator's page; it commands through the services that a terminal would use."""

    def __init__(self) -> None:
        super().__init__("page", namespace=topics.NAMESPACE)
        self.fatal_error = ""
        binding = self._read_parameters()
        # A misspelt name of a protection must not leave the page without it.
        check_overrides(self, refuse=True)
        binding.check()
        self._situation = Situation()
        self._commands = GraphCommands(self, self._situation, self._studio.limb.segment_count)
        self._replayer = Worker()
        self._picture = PictureFeed(self._picture_rate)
        self._overlay = Overlay(self._tag_map)
        self._images = None
        self._desk = Desk(self._on_lost_operator)
        parts = Parts(
            self._situation,
            self._picture,
            self._overlay,
            self._desk,
            self._commands,
            self._studio,
            self._experiments,
            self._replayer,
        )
        self._server = PageServer(binding, listen(binding), parts, lay_out)
        self._subscribe()
        self._diagnostics = DiagnosticsPublisher(self, self._health)
        self.create_timer(0.2, self._watch)
        self._server.start()
        self.get_logger().info(f"the page is at {self._server.url}")

    def _read_parameters(self) -> Binding:
        read = functools.partial(declare, self)
        share = Path(get_package_share_directory("apriltag_tracker")) / "config"
        tag_map = str(read("tag_map", str(share / "tags.yaml"), "YAML file: where the tags are"))
        self._tag_map = TagMap.from_yaml(tag_map)
        self._picture_rate = float(
            read("picture_rate", 15.0, "pictures a second at most [Hz]", at_least=1.0, at_most=30.0)  # type: ignore[arg-type]
        )
        self._policy = str(
            read(
                "on_lost_operator",
                "continue",
                "what to do when the operator's browser goes away while it commands",
                choices=POLICIES,
            )
        )
        self._studio = self._read_studio(read)
        names = read("host_names", [""], "further names by which browsers reach the page")
        return Binding(
            address=str(read("address", "127.0.0.1", "IP address to listen on")),
            port=int(
                read("port", 8080, "TCP port; 0: any free one", at_least=0, at_most=65535)  # type: ignore[arg-type]
            ),
            password=read_password(
                str(read("password_file", "", "file whose first line is the page's password"))
            ),
            certificate=str(read("certificate", "", "TLS certificate (PEM); empty: no TLS")),
            private_key=str(read("private_key", "", "key of the TLS certificate (PEM)")),
            host_names=tuple(name for name in names if name),  # type: ignore[union-attr]
        )

    def _read_studio(self, read: Any) -> Studio:
        limb_file = str(read("limb_file", "", "the planner's limb file; empty: the default limb"))
        limb = Limb.from_yaml(limb_file) if limb_file else Limb.default()
        mounting = str(read("mounting", "", "as the planner's; empty: as in the limb file"))
        payload = float(read("payload", 0.0, "as the planner's [kg]", at_least=0.0))
        place = float(read("payload_at", 0.0, "as the planner's [m]; 0: the tip", at_least=0.0))
        speed = float(read("path_speed", 0.03, "as the planner's [m/s]", at_least=1e-3))
        most = float(read("path_acceleration", 0.05, "as the planner's [m/s^2]", at_least=1e-3))
        earlier = str(read("experiments", "experiments", "folder of earlier experiments"))
        self._experiments = Experiments(Path(earlier).expanduser())
        folder = Path(str(read("drawings", "~/limb_drawings", "folder of kept drawings")))
        if mounting:
            limb = limb.mounted(mounting)
        carried = Load(payload, place)
        return Studio(limb, PathLimits(speed, most), folder.expanduser(), carried)

    # What comes in -------------------------------------------------------------------------

    def _subscribe(self) -> None:
        self._intake = Intake(self)
        subscribe = self._intake.subscribe
        subscribe(PressureState, topics.PRESSURE_STATE, self._on_driver, qos.STATES)
        subscribe(LimbState, topics.LIMB_STATE, self._on_limb, qos.STATES)
        subscribe(TagDetectionArray, topics.TAGS, self._on_tags, qos.STATES)
        subscribe(PointStamped, topics.TIP_REFERENCE, self._on_reference, qos.STATES)
        subscribe(PressurePlan, topics.PLAN, self._on_plan, qos.LATCHED)
        subscribe(MarkerArray, topics.SHAPE_MARKERS, self._on_markers, qos.STATES)
        subscribe(CameraInfo, topics.CAMERA_INFO, self._on_camera, qos.LATCHED)
        subscribe(CameraInfo, topics.CAMERA_INFO, self._on_camera, qos.IMAGES)
        subscribe(LimbEstimate, topics.ESTIMATE, self._on_estimate, qos.STATES)
        subscribe(DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, qos.STATES)
        self._intake.start()

    def _on_driver(self, message: PressureState) -> None:
        self._situation.put_driver(
            DriverState(
                mode=message.mode,
                faults=tuple(message.faults),
                plan_id=message.plan_id,
                commanded=tuple(message.commanded_differential),
                measured=tuple(message.measured_differential),
                supply=message.supply_pressure,
                telemetry_age=message.telemetry_age,
            )
        )

    def _on_limb(self, message: LimbState) -> None:
        view = LimbView(
            stamp=nanoseconds(message.header.stamp),
            valid=message.valid,
            reason=message.reason,
            tip=(message.tip.x, message.tip.y),
            bend=tuple(message.bend_angle),
            curve=tuple((point.x, point.y) for point in message.curve),
        )
        self._situation.put_limb(view)
        self._overlay.put_limb(view)

    def _on_tags(self, message: TagDetectionArray) -> None:
        tags = [
            Tag(tag.id, np.array(tag.corners).reshape(4, 2), np.zeros((8, 8)), 0.0)
            for tag in message.detections
        ]  # fmt: skip
        self._overlay.put_tags(nanoseconds(message.header.stamp), tags)

    def _on_reference(self, message: PointStamped) -> None:
        stamp = nanoseconds(message.header.stamp)
        self._situation.put_reference(stamp, message.point.x, message.point.y)

    def _on_plan(self, message: PressurePlan) -> None:
        self._situation.put_plan(
            PlanView(
                message.motion, message.model, message.method, message.limb,
                mounting_of(message.gravity), message.payload, message.payload_at,
                message.predicted_error,
            )
        )  # fmt: skip
        self._overlay.put_path(np.array(message.tip_reference).reshape(-1, 2))

    def _on_estimate(self, message: LimbEstimate) -> None:
        self._situation.put_estimate(
            EstimateView(
                tuple(message.missing_pressure), tuple(message.missing_pressure_sigma),
                tuple(message.gain_error), tuple(message.correction), message.share, message.reason,
            )
        )  # fmt: skip
        self._overlay.put_estimate(np.array([(point.x, point.y) for point in message.curve]))

    def _on_markers(self, message: MarkerArray) -> None:
        for marker in message.markers:
            if marker.ns == LIMB_MARKER:
                self._overlay.put_planned(np.array([(p.x, p.y) for p in marker.points]))

    def _on_camera(self, message: CameraInfo) -> None:
        try:
            self._overlay.put_camera(
                Intrinsics.create(
                    message.width, message.height, message.k, message.d, message.distortion_model
                )
            )
        except CameraError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=10.0)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {entry.key: entry.value for entry in status.values}
            level = int.from_bytes(status.level, "little")
            self._situation.put_status(NodeStatus(status.name, level, status.message, values))

    def _on_image(self, data: bytes) -> None:
        """Take an image as bytes: most are thrown away without being unpacked."""
        self._situation.hear("camera")
        if not self._picture.due():
            return
        message = deserialize_message(data, Image)
        try:
            grey = to_grey(
                message.data, message.height, message.width, message.step, message.encoding,
                bool(message.is_bigendian),
            )  # fmt: skip
        except ImageError as error:
            self.get_logger().warning(str(error), throttle_duration_sec=10.0)
            return
        self._picture.put(nanoseconds(message.header.stamp), grey)

    def _watch(self) -> None:
        """Subscribe to images while somebody looks; end with the server."""
        if self._server.error is not None:
            self.fatal_error = f"the page's server ended: {self._server.error}"
        if self._intake.error is not None:
            self.fatal_error = f"no more messages can be taken: {self._intake.error!r}"
        if self._picture.watched and self._images is None:
            self._images = self._intake.subscribe(
                Image, topics.IMAGE, self._on_image, qos.IMAGES, raw=True
            )
        elif not self._picture.watched and self._images is not None:
            self._intake.remove(self._images)
            self._images = None

    def _on_lost_operator(self, _window: str) -> None:
        self.get_logger().warning(f"the operator's browser is gone: {self._policy}")
        if self._policy == "stop":
            self._commands.call("stop")
        elif self._policy == "vent":
            self._commands.call("vent")

    # What it says of itself ----------------------------------------------------------------

    def _health(self) -> Health:
        values = {
            "url": self._server.url,
            "operator": "yes" if self._desk.operator else "no",
            "picture": "watched" if self._picture.watched else "nobody looks",
            "refused_requests": self._server.guard.refused,
            "refused_messages": self._intake.refused,
            "on_lost_operator": self._policy,
            "threads": threading.active_count(),
        }
        if not self._server.ready:
            return Health("stale", "the server is starting", values)
        if self._intake.refused:
            return Health("warning", self._intake.last_refused, values)
        return Health("ok", f"serving {self._server.url}", values)

    def close(self) -> None:
        """Stop serving."""
        self._intake.close()
        self._server.close()
        self._studio.previewer.close()
        self._replayer.close()


def main() -> None:
    """Entry point of `ros2 run der_planner page`."""
    cv2.setNumThreads(1)
    sys.exit(run_node(PageNode))


if __name__ == "__main__":
    main()
