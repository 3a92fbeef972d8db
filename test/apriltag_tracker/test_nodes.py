"""The tracker and the rendered camera as running nodes."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import rclpy
from domain import own_domain
from geometry_msgs.msg import Point
from pictures import image_message
from sensor_msgs.msg import CameraInfo, Image
from waiting import wait_for

from apriltag_tracker.bodies.node import PoseTrackerNode
from apriltag_tracker.bodies.tracker import PoseFrame
from apriltag_tracker.camera import CameraError
from apriltag_tracker.node import TrackerNode
from apriltag_tracker.synthetic.camera import SyntheticCamera
from apriltag_tracker.synthetic.shapes import constant_curvature
from der_msgs.msg import LimbShape, LimbState, TagDetectionArray
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds, stamp_from_nanoseconds

pytestmark = pytest.mark.graph

PATIENCE = 60.0


class ShapeStream:
    """Publishes a swinging limb 30 times a second while the test waits."""

    def __init__(self, graph, tags):
        self.node = graph.client.node
        self.tags = tags
        self.truth = {}
        self.publisher = self.node.create_publisher(LimbShape, topics.TWIN_SHAPE, qos.STATES)
        self.timer = self.node.create_timer(1.0 / 30.0, self.publish)

    def publish(self):
        now = self.node.get_clock().now().nanoseconds
        time = now * 1e-9 % 1000.0
        bends = [0.7 * np.sin(time), 0.7 * np.sin(1.3 * time)]
        shape = constant_curvature(self.tags.segment_lengths, bends, points=61)
        message = LimbShape(
            arc_length=shape.arc_length.tolist(),
            heading=shape.heading.tolist(),
            points=[Point(x=x, y=y) for x, y in shape.points.tolist()],
        )
        message.header.stamp = stamp_from_nanoseconds(now)
        self.truth[now] = shape.points[-1]
        self.publisher.publish(message)


@pytest.fixture
def states(graph):
    received = []
    graph.client.subscribe(LimbState, topics.LIMB_STATE, qos.STATES, received.append)
    return received


def test_shapes_become_images_and_images_become_the_tip(graph, states, tags):
    client = graph.client
    seen = []
    client.subscribe(TagDetectionArray, topics.TAGS, qos.STATES, seen.append)
    camera = graph.start("apriltag_tracker", "synthetic_camera", seed=2)
    tracker = graph.start("apriltag_tracker", "apriltag_tracker")
    client.watch([camera, tracker])
    stream = ShapeStream(graph, tags)
    client.wait_for(lambda: sum(state.valid for state in states) > 45, PATIENCE, "valid states")
    client.wait_ready(["synthetic_camera", "apriltag_tracker"])
    valid = [state for state in states if state.valid]
    errors = []
    for state in valid:
        stamp = nanoseconds(state.header.stamp)
        assert stamp in stream.truth  # the stamp of the image is that of the shape
        errors.append(np.array([state.tip.x, state.tip.y]) - stream.truth[stamp])
        assert 0.0 < state.latency < PATIENCE
        assert state.header.frame_id == topics.BASE_FRAME
    # Stiff stretches of the tag map are not in these arcs: a quarter of a millimetre is allowed.
    assert np.sqrt(np.mean(np.sum(np.square(errors), axis=1))) < 2.5e-4
    assert len({nanoseconds(state.header.stamp) for state in states}) == len(states)

    detections = seen[-1].detections
    assert {detection.id for detection in detections} <= set(tags.ids)
    assert all(detection.pose_valid for detection in detections)
    assert {d.id for d in detections if d.on_limb} <= {tag.id for tag in tags.limb}

    pictures = []
    client.subscribe(Image, "camera/image_annotated", qos.IMAGES, pictures.append)
    client.wait_for(lambda: pictures, PATIENCE, "an annotated picture")
    assert pictures[0].encoding == "bgr8"
    assert len(pictures[0].data) == 3 * 1280 * 720


def test_bad_input_is_named_and_gives_no_state(graph, states, tags, model):
    client = graph.client
    tracker = graph.start("apriltag_tracker", "apriltag_tracker", bridge_frames=0)
    client.watch([tracker])
    # Reliable here, best effort in the other test: the tracker hears both.
    images = client.node.create_publisher(Image, topics.IMAGE, qos.STATES)
    infos = client.node.create_publisher(CameraInfo, topics.CAMERA_INFO, qos.LATCHED)
    client.wait_for(
        lambda: images.get_subscription_count() and infos.get_subscription_count(),
        PATIENCE,
        "the tracker's subscriptions",
    )
    camera = SyntheticCamera(model, tags)
    good = camera.frame(constant_curvature(tags.segment_lengths, [0.3, 0.2])).image
    now = client.node.get_clock().now().nanoseconds

    def answer(message):
        wanted = nanoseconds(message.header.stamp)
        images.publish(message)
        return client.wait_for(
            lambda: next((s for s in states if nanoseconds(s.header.stamp) == wanted), None),
            PATIENCE,
            f"the state at {wanted}",
        )

    state = answer(image_message(good, now + 1))
    assert not state.valid
    assert "camera_info" in state.reason
    assert np.isnan(state.tip.x)

    lens = model.intrinsics
    info = CameraInfo(width=lens.width, height=lens.height, distortion_model="plumb_bob")
    info.k, info.d = lens.matrix.ravel().tolist(), lens.distortion[:5].tolist()
    infos.publish(info)
    # The calibration may come after the image.
    for offset in range(100, 250):
        state = answer(image_message(good, now + offset))
        if state.valid:
            break
    assert state.tags_used == len(tags.limb)

    state = answer(image_message(good[:480, :640], now + 301))
    assert not state.valid
    assert "640 x 480" in state.reason


@pytest.fixture
def make_here():
    """Return a function that makes a tracker in this process, with parameters of its own."""

    def make(kind, **parameters):
        words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        rclpy.init(args=["--ros-args", *words], domain_id=own_domain(__file__))
        return kind()

    yield make
    rclpy.shutdown()


def test_pictures_of_a_folder_are_tracked(make_here, tags, model, tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    camera = SyntheticCamera(model, tags)
    shape = constant_curvature(tags.segment_lengths, [0.3, 0.2])
    for k in range(3):
        cv2.imwrite(str(folder / f"{k:03d}.png"), camera.frame(shape).image)
    lens = tmp_path / "camera.yaml"
    model.intrinsics.to_yaml(lens)
    node = make_here(TrackerNode, source=folder, source_rate=10.0, calibration_file=lens)
    states = []
    node.create_subscription(LimbState, topics.LIMB_STATE, states.append, qos.STATES)
    wait_for(lambda: rclpy.spin_once(node, timeout_sec=0.1) or states, "a state", PATIENCE)
    node.destroy_node()
    tip = states[0].tip
    assert states[0].valid
    assert np.hypot(*np.subtract([tip.x, tip.y], shape.points[-1])) < 5e-4


def test_a_source_without_calibration_is_refused_with_the_remedy(make_here):
    with pytest.raises(CameraError, match="calibration_file"):
        make_here(TrackerNode, source="/nowhere/video.avi")


def test_poses_of_motion_capture_become_the_tip(graph, states, config, tags, tmp_path):
    """The poses come in millimetres, some are lost."""
    body_map = tmp_path / "bodies.yaml"
    text = (config / "bodies.yaml").read_text().replace("length_unit: m ", "length_unit: mm ")
    body_map.write_text(text)
    mapped = {"body_map": str(body_map)}
    mocap = graph.start("apriltag_tracker", "synthetic_poses", dropout=0.02, **mapped)
    tracker = graph.start("apriltag_tracker", "pose_tracker", **mapped)
    client = graph.client
    client.watch([mocap, tracker])
    stream = ShapeStream(graph, tags)
    client.wait_for(lambda: sum(state.valid for state in states) > 45, PATIENCE, "valid states")
    client.wait_ready(["synthetic_poses", "pose_tracker"])
    valid = [state for state in states if state.valid and state.tags_used == len(tags.limb)]
    errors = [
        np.array([state.tip.x, state.tip.y]) - stream.truth[nanoseconds(state.header.stamp)]
        for state in valid
    ]
    # Noise of 0.1 mm, and stiff stretches of the map that these arcs have not. A machine that stood
    # still sends shapes within milliseconds, whose bodies are then put together.
    assert np.median(np.linalg.norm(errors, axis=1)) < 3e-4
    told = client.wait_for(
        lambda: client.diagnostic_values("pose_tracker").get("plane_tilt_deg"), PATIENCE, "a plane"
    )
    assert float(told) < 1.0


def test_poses_that_tell_no_limb_are_an_error_with_all_that_is_known(make_here):
    node = make_here(PoseTrackerNode)
    node._assembler.astray["limb_5"] = 3.0
    frame = PoseFrame(10**9, np.full((8, 3), np.nan), np.full((8, 4), np.nan))
    node._on_frame(frame)
    node._tracker.base.problem = ""
    told = node._health()
    node.destroy_node()
    assert told.level == "error"
    assert "no base" in told.message
    assert "stamps of limb_5 are 3.00 s off the others'" in told.message
    assert "s old: are they of another clock?" in told.message
