"""The tracker on scenes of tags, on a limb that swings, and as a node beside twin and camera.

Scenes tell tags found, corner errors and honesty of the covariance beside the AprilTag 3 C library.
Both detectors run in one thread on the same pictures; times are CPU times. NEES / 8 is the squared
error of a tag's corners in units of the covariance that is stated, per number: 1 is honest, above
is overconfident.
"""

from __future__ import annotations

import contextlib
import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pyapriltags
from numpy.typing import NDArray

from apriltag_tracker.detection import Detector
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.tag_map import TagMap
from benchmarks import show
from benchmarks.tracker import Swing
from benchmarks.tracker.renderer import Scene, render
from der_msgs.msg import ChamberPressures, LimbState
from der_planner.experiment.client import GraphClient
from der_planner.experiment.console import Progress
from der_planner.experiment.graph_run import RunningGraph
from der_planner.experiment.processes import NodeSpec
from limb_interfaces import qos, topics
from limb_interfaces.stamps import nanoseconds
from workspace_setup.basics import ROOT

CONFIG = ROOT / "src" / "apriltag_tracker" / "config"
PERIOD = 1.0 / 30.0
SCENES = (
    Scene("14px", pixels=14.0, blur=0.5),
    Scene("30px"),
    Scene("noise_12", noise=12.0),
    Scene("smear_4px", smear=4.0),
    Scene("smear_6px", smear=6.0),
    Scene("dark_0.12", contrast=0.12),
    Scene("corner_covered", corner=0.25),
)

_FIRST_SEED = 900
"""First seed of the pictures; the deviation of badly fitting corners was set with them in view."""

_WRONG = 3.0
"""A tag whose corners are further off is a false one [px]."""

Found = dict[int, tuple[NDArray[np.float64], NDArray[np.float64] | None]]
"""Corners (4, 2) px by id, with their covariance (8, 8) px² where one is stated."""


def detectors() -> dict[str, Callable[[NDArray[np.uint8]], Found]]:
    """Return ours and the C library, which counts pixels from their corners, as functions."""
    ours = Detector()

    def c_library(decimate: float) -> Callable[[NDArray[np.uint8]], Found]:
        theirs = pyapriltags.Detector(families="tag36h11", nthreads=1, quad_decimate=decimate)
        return lambda image: {
            tag.tag_id: (np.asarray(tag.corners) - 0.5, None) for tag in theirs.detect(image)
        }

    return {
        "ours": lambda image: {tag.id: (tag.corners, tag.covariance) for tag in ours.detect(image)},
        "c_decimate_1": c_library(1.0),
        "c_decimate_2": c_library(2.0),
    }


def measure_scenes(pictures: int) -> dict[str, float]:
    """Print and return the table of all scenes."""
    print(f"{'':15s} | found %: ours, C 1, C 2 | corner RMS px | NEES / 8 | false | CPU ms")
    result: dict[str, float] = {}
    for scene in SCENES:
        rendered = [render(scene, seed) for seed in range(_FIRST_SEED, _FIRST_SEED + pictures)]
        rows = {}
        for name, detect in detectors().items():
            rows[name] = _score(rendered, detect)
            result.update({f"{scene.name}_{name}_{key}": v for key, v in rows[name].items()})
        columns = [
            " ".join(f"{row[key]:{form}}" for row in rows.values())
            for key, form in (("found_percent", "6.1f"), ("corner_rms_px", "6.3f"))
        ]
        ours = rows["ours"]
        times = " ".join(f"{row['cpu_ms_a_picture']:6.1f}" for row in rows.values())
        print(
            f"{scene.name:15s} | {' | '.join(columns)} | {ours['nees']:.2f} | "
            f"{ours['false']:.0f} | {times}",
            flush=True,
        )
    return result


def _score(
    rendered: list[tuple[NDArray[np.uint8], dict[int, NDArray[np.float64]]]],
    detect: Callable[[NDArray[np.uint8]], Found],
) -> dict[str, float]:
    """Compare what a detector finds with the truth."""
    false, seconds, gaps, nees = 0, 0.0, [], []
    for image, truth in rendered:
        started = time.process_time()
        found = detect(image)
        seconds += time.process_time() - started
        for tag, (corners, covariance) in found.items():
            gap = (corners - truth[tag]).ravel() if tag in truth else np.full(8, np.inf)
            if np.abs(gap).max() > _WRONG:
                false += 1
                continue
            gaps.append(gap)
            if covariance is not None:
                nees.append(gap @ np.linalg.solve(covariance, gap) / 8.0)
    return {
        "found_percent": 100.0 * len(gaps) / sum(len(truth) for _, truth in rendered),
        "corner_rms_px": float(np.sqrt(np.mean(np.square(gaps)))) if gaps else float("nan"),
        "nees": float(np.mean(nees)) if nees else float("nan"),
        "false": float(false),
        "cpu_ms_a_picture": 1e3 * seconds / len(rendered),
    }


def measure_false_tags(count: int) -> dict[str, float]:
    """Count tags in random pictures: noise of all grains, half of them with squares of codes."""
    detector, random, false = Detector(), np.random.default_rng(11), 0
    for k in range(count):
        coarse = random.integers(0, 256, random.integers(8, 200, 2), dtype=np.uint8)
        image = cv2.resize(coarse, (640, 480), interpolation=(0, 1, 2)[k % 3])
        for _ in range(40 * (k % 2)):
            x, y, side = (int(value) for value in random.integers(0, 400, 3))
            cells = np.pad(random.integers(0, 2, (6, 6), dtype=np.uint8) * 255, 1)
            side = 12 + side // 10
            image[y : y + side, x : x + side] = cv2.resize(cells, (side, side), interpolation=0)
        false += len(detector.detect(image))
    print(f"\nFalse tags in {count} random pictures: {false}")
    return {"random_pictures": float(count), "false_tags_in_random_pictures": float(false)}


def measure_swing(frames: int, exposure: float) -> dict[str, float]:
    """Follow a swinging limb."""
    tags = dataclasses.replace(TagMap.from_yaml(CONFIG / "tags.yaml"), stiff=())
    model = CameraModel.from_yaml(CONFIG / "synthetic_camera.yaml")
    camera = SyntheticCamera(model, tags, Optics(exposure=exposure))
    tracker, swing = LimbTracker(tags, model.intrinsics), Swing(tags)
    times, gaps, nees, corners, asked = [], [], [], [], 0
    for k in range(frames):
        shape = swing.shape(k * PERIOD)
        frame = camera.frame(shape, swing.velocity(k * PERIOD))
        begin = time.process_time()
        observation = tracker.observe(frame.image, k * PERIOD)
        times.append(1e3 * (time.process_time() - begin))
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
    }
    name = f"swing_{1e3 * exposure:.0f}ms"
    print(f"\nA limb that swings, {1e3 * exposure:.0f} ms of exposure, {frames} pictures")
    show(result)
    return {f"{name}_{key}": value for key, value in result.items()}


def measure_graph(seconds: float) -> dict[str, float]:
    """Run twin, camera and tracker as nodes and compare the tracker's tip with the twin's own."""
    states: dict[int, LimbState] = {}
    truth: dict[int, LimbState] = {}
    packages = {"limb_twin": "der_planner"}
    packages |= dict.fromkeys(("synthetic_camera", "apriltag_tracker"), "apriltag_tracker")
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        client = stack.enter_context(GraphClient("benchmark"))
        for topic, kept in ((topics.LIMB_STATE, states), (topics.TWIN_GROUND_TRUTH, truth)):

            def keep(message: LimbState, kept: dict[int, LimbState] = kept) -> None:
                kept[nanoseconds(message.header.stamp)] = message

            client.subscribe(LimbState, topic, qos.STATES, keep)
        _press(client)
        graph = RunningGraph(client, Progress())
        stack.callback(graph.stop)
        specs = [NodeSpec(package, name) for name, package in packages.items()]
        graph.start(specs, folder, {})
        client.wait_for(lambda: len(states) > 60, 60.0, "the tracker")
        states.clear()
        started = time.monotonic()
        client.spin(seconds)
        took = time.monotonic() - started
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
    print(f"\nNodes, {took:.0f} s; latency from the shape's stamp to the published tip")
    show(result)
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
