"""The tracker on a limb that swings: picture by picture, and as a node beside twin and camera."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from apriltag_tracker.detection import Detector
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.synthetic.shapes import Shape, constant_curvature
from apriltag_tracker.tag_map import TagMap
from benchmarks.tracker.table import measure_false_tags, measure_scenes
from der_msgs.msg import ChamberPressures, LimbState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.processes import NodeProcess
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds
from workspace_setup.basics import ROOT

CONFIG = ROOT / "src" / "apriltag_tracker" / "config"
PERIOD = 1.0 / 30.0
_DOMAIN = "97"


def swing(tags: TagMap, moment: float) -> Shape:
    """Return the limb at a moment [s]: each segment swings at its own period."""
    bends = 0.8 * np.sin(2.0 * np.pi * moment / np.array([3.0, 4.0]))
    return constant_curvature(tags.segment_lengths, bends.tolist())


def measure_swing(frames: int, exposure: float) -> dict[str, float]:
    """Follow a swinging limb; each picture is also searched in full."""
    tags = dataclasses.replace(TagMap.from_yaml(CONFIG / "tags.yaml"), stiff=())
    model = CameraModel.from_yaml(CONFIG / "synthetic_camera.yaml")
    camera = SyntheticCamera(model, tags, Optics(exposure=exposure))
    tracker, detector = LimbTracker(tags, model.intrinsics), Detector(smallest=14.0)
    times, searches, renders, gaps, nees, corners, asked = [], [], [], [], [], [], 0
    for k in range(frames):
        shape, later = swing(tags, k * PERIOD), swing(tags, k * PERIOD + 1e-3)
        points, heading = later.points - shape.points, later.heading - shape.heading
        moments = [time.process_time()]
        frame = camera.frame(shape, Shape(shape.arc_length, 1e3 * points, 1e3 * heading))
        moments.append(time.process_time())
        observation = tracker.observe(frame.image, k * PERIOD, search_later=True)
        moments.append(time.process_time())
        detector.detect(frame.image)
        moments.append(time.process_time())
        tracker.search_again(frame.image)
        for kept, took in zip((renders, times, searches), np.diff(moments), strict=True):
            kept.append(1e3 * took)
        asked += len(frame.corners)
        seen = [placed.tag for placed in observation.tags]
        corners += [tag.corners - frame.corners[tag.id] for tag in seen]
        if observation.estimate is not None and not observation.bridged:
            gap = observation.estimate.tip - shape.points[-1]
            gaps.append(1e3 * gap)
            spread = observation.estimate.tip_covariance
            nees.append(gap @ np.linalg.solve(spread, gap) / 2.0)
    off = np.hypot(*np.array(gaps).T)
    result = {
        "found_percent": 100.0 * len(corners) / asked,
        "corner_rms_px": float(np.sqrt(np.mean(np.square(corners)))),
        "valid_percent": 100.0 * len(gaps) / frames,
        "tip_rms_mm": float(np.sqrt(np.mean(off**2))),
        "tip_max_mm": float(off.max()),
        "tip_nees": float(np.mean(nees)),
        "image_to_limb_median_cpu_ms": float(np.median(times)),
        "image_to_limb_p99_cpu_ms": float(np.percentile(times, 99)),
        "full_search_cpu_ms": float(np.median(searches)),
        "render_cpu_ms": float(np.median(renders)),
    }
    name = f"swing_{1e3 * exposure:.0f}ms"
    _show(f"A limb that swings, {1e3 * exposure:.0f} ms of exposure, {frames} pictures", result)
    return {f"{name}_{key}": value for key, value in result.items()}


def measure_graph(seconds: float) -> dict[str, float]:
    """Run twin, camera and tracker as nodes and compare the tracker's tip with the twin's own."""
    states: dict[int, LimbState] = {}
    truth: dict[int, LimbState] = {}
    names = {"limb_twin": "der_planner", "synthetic_camera": "apriltag_tracker"}
    names["apriltag_tracker"] = "apriltag_tracker"
    with (
        tempfile.TemporaryDirectory() as folder,
        GraphClient("tracker_benchmark", int(_DOMAIN)) as client,
    ):
        environment = {**os.environ, "ROS_DOMAIN_ID": _DOMAIN}
        nodes = {
            name: NodeProcess(package, name, {}, Path(folder), None, environment, name)
            for name, package in names.items()
        }
        try:
            client.watch(list(nodes.values()))
            for topic, kept in ((topics.LIMB_STATE, states), (topics.TWIN_GROUND_TRUTH, truth)):
                client.subscribe(
                    LimbState,
                    topic,
                    qos.STATES,
                    lambda message, kept=kept: kept.update(
                        {nanoseconds(message.header.stamp): message}
                    ),
                )
            _press(client)
            client.wait_for(lambda: len(states) > 60, 60.0, "the tracker")
            states.clear()
            before = {name: node.measure_cpu() for name, node in nodes.items()}
            started = time.monotonic()
            client.spin(seconds)
            took = time.monotonic() - started
            cpu = {name: node.measure_cpu() - before[name] for name, node in nodes.items()}
        finally:
            for node in nodes.values():
                node.stop()
    both = [stamp for stamp in states if stamp in truth and states[stamp].valid]
    gaps = 1e3 * np.array(
        [(states[k].tip.x - truth[k].tip.x, states[k].tip.y - truth[k].tip.y) for k in both]
    )
    latency = 1e3 * np.array([states[k].latency for k in both])
    result = {
        "graph_states_per_s": len(states) / took,
        "graph_valid_percent": 100.0 * len(both) / max(len(states), 1),
        "graph_tip_rms_mm": float(np.sqrt(np.mean(np.sum(gaps**2, axis=1)))),
        "graph_tip_max_mm": float(np.hypot(*gaps.T).max()),
        "graph_latency_median_ms": float(np.median(latency)),
        "graph_latency_p99_ms": float(np.percentile(latency, 99)),
    }
    result.update({f"graph_cpu_{name}_percent": 100.0 * used / took for name, used in cpu.items()})
    _show(f"Nodes, {took:.0f} s; latency from the shape's stamp to the published tip", result)
    return result


def _press(client: GraphClient) -> None:
    """Publish chamber pressures that make the twin swing with a period of 3 s."""
    publisher = client.node.create_publisher(
        ChamberPressures, topics.TWIN_CHAMBER_PRESSURES, qos.STATES
    )
    begin = time.monotonic()

    def publish() -> None:
        moment = time.monotonic() - begin
        swing = 12e3 * np.sin(2.0 * np.pi * moment / 3.0) * min(moment / 3.0, 1.0)
        message = ChamberPressures(
            pressure=(101325.0 + np.maximum([swing, -swing] * 2, 0.0)).tolist()
        )
        message.header.stamp = client.node.get_clock().now().to_msg()
        publisher.publish(message)

    client.node.create_timer(0.02, publish)


def _show(title: str, figures: dict[str, float]) -> None:
    print(f"\n{title}")
    for key, value in figures.items():
        print(f"  {key:42s} {value:9.3f}", flush=True)


def run(quick: bool) -> dict[str, float | str]:
    """Measure everything; `quick` takes fewer pictures."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        result: dict[str, float | str] = {"opencv": cv2.__version__}
        result.update(measure_scenes(1 if quick else 3))
        result.update(measure_false_tags(100 if quick else 1000))
        for exposure in (0.004, 0.010):
            result.update(measure_swing(45 if quick else 120, exposure))
        result.update(measure_graph(8.0 if quick else 20.0))
    finally:
        cv2.setNumThreads(threads)
    return result
