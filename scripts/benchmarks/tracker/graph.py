"""The tracker in a running graph with the twin and the synthetic camera."""

from __future__ import annotations

import array
import itertools
import os
import tempfile
import time
from pathlib import Path

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from benchmarks.tracker.pictures import PERIOD, swinging_limb
from der_msgs.msg import ChamberPressures, LimbState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.processes import NodeProcess
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds

_PERIODS = (3.0, 3.0)
"""Of the two segments' pressures [s]."""

_CYCLE = 360
"""Pictures after which `swinging_limb` is where it began."""


def measure_graph(seconds: float) -> dict[str, float]:
    """Run twin, camera and tracker as nodes and compare the tracker's tip with the twin's own."""
    states: dict[int, LimbState] = {}
    truth: dict[int, LimbState] = {}
    with tempfile.TemporaryDirectory() as folder, GraphClient("tracker_benchmark", 97) as client:
        environment = {**os.environ, "ROS_DOMAIN_ID": "97"}
        nodes = [
            NodeProcess(package, name, {}, Path(folder), None, environment, name)
            for package, name in (
                ("der_planner", "limb_twin"),
                ("apriltag_tracker", "synthetic_camera"),
                ("apriltag_tracker", "apriltag_tracker"),
            )
        ]
        try:
            client.watch(nodes)
            client.subscribe(
                LimbState,
                topics.LIMB_STATE,
                qos.STATES,
                lambda message: states.update({nanoseconds(message.header.stamp): message}),
            )
            client.subscribe(
                LimbState,
                topics.TWIN_GROUND_TRUTH,
                qos.STATES,
                lambda message: truth.update({nanoseconds(message.header.stamp): message}),
            )
            _press(client)
            client.wait_for(lambda: len(states) > 60, 60.0, "the tracker")
            states.clear()
            truth.clear()
            before = [node.measure_cpu() for node in nodes]
            started = time.monotonic()
            client.spin(seconds)
            took = time.monotonic() - started
            after = [node.measure_cpu() for node in nodes]
        finally:
            for node in nodes:
                node.stop()
    both = [stamp for stamp in states if stamp in truth and states[stamp].valid]
    gaps = np.array(
        [(states[k].tip.x - truth[k].tip.x, states[k].tip.y - truth[k].tip.y) for k in both]
    )
    latency = 1e3 * np.array([states[k].latency for k in both])
    result = {
        "graph_states_per_s": len(states) / took,
        "graph_shapes_per_s": len(truth) / took,
        "graph_valid_percent": 100.0 * len(both) / max(len(states), 1),
        "graph_tip_rms_mm": 1e3 * float(np.sqrt(np.mean(np.sum(gaps**2, axis=1)))),
        "graph_tip_max_mm": 1e3 * float(np.hypot(*gaps.T).max()),
        "graph_latency_median_ms": float(np.median(latency)),
        "graph_latency_p99_ms": float(np.percentile(latency, 99)),
    }
    for node, first, last in zip(("twin", "camera", "tracker"), before, after, strict=True):
        result[f"graph_cpu_{node}_percent"] = 100.0 * (last - first) / took
    print(f"\nTwin, camera and tracker as nodes, {took:.0f} s; latency from stamp to published tip")
    for key, value in result.items():
        print(f"  {key:42s} {value:9.3f}")
    return result


def _press(client: GraphClient) -> None:
    """Publish chamber pressures that make the twin swing, 50 times a second."""
    publisher = client.node.create_publisher(
        ChamberPressures, topics.TWIN_CHAMBER_PRESSURES, qos.STATES
    )
    begin = time.monotonic()

    def publish() -> None:
        moment = time.monotonic() - begin
        swing = 12e3 * np.sin(2.0 * np.pi * moment / np.array(_PERIODS))
        chambers = 101325.0 + np.array(
            [max(swing[0], 0.0), max(-swing[0], 0.0), max(swing[1], 0.0), max(-swing[1], 0.0)]
        ) * min(moment / 3.0, 1.0)
        message = ChamberPressures(pressure=chambers.tolist())
        message.header.stamp = client.node.get_clock().now().to_msg()
        publisher.publish(message)

    client.node.create_timer(0.02, publish)


def measure_ready_pictures(seconds: float) -> dict[str, float]:
    """Send rendered pictures of a swinging limb to the tracker's node, stamped as they are sent.

    What is left of the latency is the way to the tracker and its own time: what a camera sees whose
    stamp is the moment at which its picture is ready.
    """
    tags, model, pictures, _ = swinging_limb(_CYCLE, 1.0)
    lens = model.intrinsics
    latency: list[float] = []
    messages = [
        Image(
            height=lens.height,
            width=lens.width,
            encoding="mono8",
            step=lens.width,
            data=array.array("B", frame.image.tobytes()),
        )
        for frame in pictures
    ]
    info = CameraInfo(
        height=lens.height,
        width=lens.width,
        distortion_model="plumb_bob",
        d=lens.distortion[:5].tolist(),
        k=lens.matrix.ravel().tolist(),
    )
    with tempfile.TemporaryDirectory() as folder, GraphClient("tracker_benchmark", 97) as client:
        environment = {**os.environ, "ROS_DOMAIN_ID": "97"}
        name = "apriltag_tracker"
        node = NodeProcess(name, name, {}, Path(folder), None, environment, name)
        try:
            client.watch([node])
            client.subscribe(
                LimbState,
                topics.LIMB_STATE,
                qos.STATES,
                lambda state: latency.append(state.latency) if state.valid else None,
            )
            client.node.create_publisher(CameraInfo, topics.CAMERA_INFO, qos.LATCHED).publish(info)
            images = client.node.create_publisher(Image, topics.IMAGE, qos.SENSOR_DATA)
            following = itertools.cycle(messages)

            def publish() -> None:
                message = next(following)
                message.header.stamp = client.node.get_clock().now().to_msg()
                images.publish(message)

            client.node.create_timer(PERIOD, publish)
            client.wait_for(lambda: len(latency) > 60, 60.0, "the tracker")
            latency.clear()
            client.spin(seconds)
        finally:
            node.stop()
    result = {
        "ready_pictures_states_per_s": len(latency) / seconds,
        "ready_pictures_latency_median_ms": 1e3 * float(np.median(latency)),
        "ready_pictures_latency_p99_ms": 1e3 * float(np.percentile(latency, 99)),
    }
    print(
        f"\nReady pictures of {len(tags.ids)} tags to the tracker's node, stamped as they are sent"
    )
    for key, value in result.items():
        print(f"  {key:42s} {value:9.3f}")
    return result
