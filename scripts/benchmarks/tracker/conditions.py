"""The tracker's figures, beside the AprilTag 3 C library (`pyapriltags`) on the same pictures.

Every picture is rendered in closed form with known corners. Both detectors run in one thread; times
are CPU times, which other programs on the machine change little.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pyapriltags
from numpy.typing import NDArray

from apriltag_tracker.detection import Detector
from apriltag_tracker.detection.tracking import TagTracker
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import CameraModel, Frame, SyntheticCamera
from apriltag_tracker.tag_map import TagMap
from benchmarks.tracker.graph import measure_graph, measure_ready_pictures
from benchmarks.tracker.pictures import (
    CONDITIONS,
    CONFIG,
    PERIOD,
    picture,
    swing,
    swinging_limb,
    tag_field,
)
from benchmarks.tracker.quality import measure_fast_limb, measure_fixed_tags, measure_quality

_SETTLED = 36
"""Pictures after which fixed tags are fitted in turn."""


@dataclass
class Score:
    """Errors of one detector under one condition."""

    corner: list[NDArray[np.float64]]
    centre: list[NDArray[np.float64]]
    seen: int = 0
    asked: int = 0
    false: int = 0
    seconds: float = 0.0
    pictures: int = 0

    def add(
        self, truth: dict[int, NDArray[np.float64]], found: dict[int, NDArray[np.float64]]
    ) -> None:
        """Compare one picture's corners with the truth."""
        self.asked += len(truth)
        self.pictures += 1
        for tag, corners in found.items():
            if tag not in truth:
                self.false += 1
                continue
            gap = corners - truth[tag]
            if np.abs(gap).max() > 5.0:
                self.false += 1
                continue
            self.seen += 1
            self.corner.append(gap)
            self.centre.append(_centre(corners) - _centre(truth[tag]))

    def figures(self) -> dict[str, float]:
        """Return rate, corner and centre RMS a coordinate, and time."""
        rms = [
            float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")
            for errors in (self.corner, self.centre)
        ]
        return {
            "detected_percent": 100.0 * self.seen / max(self.asked, 1),
            "corner_rms_px": rms[0],
            "centre_rms_px": rms[1],
            "cpu_ms_a_picture": 1e3 * self.seconds / max(self.pictures, 1),
            "false_tags": float(self.false),
        }


def _centre(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where the diagonals cross: the mean of the corners is another point in perspective."""
    a, b, c, d = corners
    along, across, gap = c - a, d - b, b - a
    share = (gap[0] * across[1] - gap[1] * across[0]) / (
        along[0] * across[1] - along[1] * across[0]
    )
    result: NDArray[np.float64] = a + share * along
    return result


def c_library(decimate: float) -> Callable[[NDArray[np.uint8]], dict[int, NDArray[np.float64]]]:
    """Return the C library as a function of an image; its pixels count from their corners."""
    detector = pyapriltags.Detector(families="tag36h11", nthreads=1, quad_decimate=decimate)

    def detect(image: NDArray[np.uint8]) -> dict[int, NDArray[np.float64]]:
        return {tag.tag_id: np.asarray(tag.corners) - 0.5 for tag in detector.detect(image)}

    return detect


def our_search() -> Callable[[NDArray[np.uint8]], dict[int, NDArray[np.float64]]]:
    """Return our full search as a function of an image."""
    detector = Detector(smallest=12.0)
    return lambda image: {tag.id: tag.corners for tag in detector.detect(image)}


def measure_conditions(pictures: int) -> dict[str, float]:
    """Compare the detectors picture by picture under every condition."""
    detectors = {
        "ours": our_search(),
        "c_decimate_1": c_library(1.0),
        "c_decimate_2": c_library(2.0),
    }
    result: dict[str, float] = {}
    print(
        f"{'condition':15s} | detected % (ours, C 1, C 2) | corner RMS px       "
        "| centre RMS px       | CPU ms a picture"
    )
    for condition in CONDITIONS:
        scores = {name: Score([], []) for name in detectors}
        for seed in range(pictures):
            frame = picture(tag_field(condition, seed), condition)
            truth = {tag: corners for tag, corners in frame.corners.items() if tag != 500}
            for name, detect in detectors.items():
                started = time.process_time()
                found = detect(frame.image)
                scores[name].seconds += time.process_time() - started
                scores[name].add(truth, found)
        rows = {name: score.figures() for name, score in scores.items()}
        for name, figures in rows.items():
            result.update(
                {f"{condition.name}_{name}_{key}": value for key, value in figures.items()}
            )
        columns = [
            " ".join(f"{row[key]:{form}}" for row in rows.values())
            for key, form in (
                ("detected_percent", "8.1f"),
                ("corner_rms_px", "6.3f"),
                ("centre_rms_px", "6.3f"),
                ("cpu_ms_a_picture", "6.1f"),
            )
        ]
        print(f"{condition.name:15s} | {' | '.join(columns)}", flush=True)
    return result


def _searched_by_c(pictures: Sequence[Frame], decimate: float) -> dict[str, float]:
    """Return the figures of the C library, which searches every picture."""
    detect, score = c_library(decimate), Score([], [])
    for frame in pictures:
        started = time.process_time()
        found = detect(frame.image)
        score.seconds += time.process_time() - started
        score.add(frame.corners, found)
    return score.figures()


def measure_sequence(frames: int, scale: float, name: str) -> dict[str, float]:
    """Track a swinging limb and search every picture with the C library."""
    tags, model, pictures, tips = swinging_limb(frames, scale)
    detector = Detector(smallest=14.0)
    tracker = TagTracker(tags.ids, detector)
    tracked, full = Score([], []), Score([], [])
    times, kinds = [], []
    for k, frame in enumerate(pictures):
        before = tracker.counts.full_searches
        started = time.process_time()
        found = tracker.track(frame.image, k * PERIOD)
        times.append(time.process_time() - started)
        kinds.append(tracker.counts.full_searches > before)
        tracked.add(frame.corners, {tag.id: tag.corners for tag in found})
        started = time.process_time()
        seen = detector.detect(frame.image)
        full.seconds += time.process_time() - started
        full.add(frame.corners, {tag.id: tag.corners for tag in seen})
    limb = LimbTracker(tags, model.intrinsics, detector=detector)
    tip_errors, whole = [], []
    for k, (frame, tip) in enumerate(zip(pictures, tips, strict=True)):
        started = time.process_time()
        observation = limb.observe(frame.image, k * PERIOD)
        whole.append(time.process_time() - started)
        if observation.estimate is not None and not observation.bridged:
            tip_errors.append(observation.estimate.tip - tip)
    only = np.array(times)[~np.array(kinds)]
    result = {
        "tracked_frame_median_cpu_ms": 1e3 * float(np.median(only)),
        "tracked_frame_p99_cpu_ms": 1e3 * float(np.percentile(only, 99)),
        "full_search_cpu_ms": full.figures()["cpu_ms_a_picture"],
        "image_to_limb_median_cpu_ms": 1e3 * float(np.median(whole)),
        "image_to_limb_settled_cpu_ms": 1e3 * float(np.median(whole[_SETTLED:] or whole)),
        "image_to_limb_mean_cpu_ms": 1e3 * float(np.mean(whole)),
        "tracked_detected_percent": tracked.figures()["detected_percent"],
        "tracked_corner_rms_px": tracked.figures()["corner_rms_px"],
        "full_corner_rms_px": full.figures()["corner_rms_px"],
        "tip_rms_mm": 1e3 * float(np.sqrt(np.mean(np.sum(np.square(tip_errors), axis=1)))),
        "tip_max_mm": 1e3 * float(np.hypot(*np.array(tip_errors).T).max()),
        "valid_percent": 100.0 * len(tip_errors) / len(pictures),
    }
    for decimate in (1.0, 2.0):
        peer = _searched_by_c(pictures, decimate)
        result.update({f"c_decimate_{decimate:.0f}_{key}": value for key, value in peer.items()})
    result["times_faster_than_c_decimate_2"] = (
        result["c_decimate_2_cpu_ms_a_picture"] / result["tracked_frame_median_cpu_ms"]
    )
    print(f"\nA swinging limb, {name}, {frames} pictures of {len(tags.ids)} tags")
    for key, value in result.items():
        print(f"  {key:42s} {value:9.3f}")
    return {f"{name}_{key}": value for key, value in result.items()}


def measure_false_tags(count: int) -> dict[str, float]:
    """Count tags in random pictures: noise of all grains, lines, rectangles."""
    detector = Detector()
    random = np.random.default_rng(11)
    false = 0
    for k in range(count):
        grain = random.integers(8, 200, 2)
        coarse = random.integers(0, 256, grain, dtype=np.uint8)
        image = cv2.resize(coarse, (640, 480), interpolation=(0, 1, 2)[k % 3])
        if k % 2:
            for _ in range(40):
                x, y, side = (int(value) for value in random.integers(0, 460, 3))
                side = 12 + side // 10
                cv2.rectangle(image, (x, y), (x + side, y + side), int(random.integers(0, 60)), -1)
                cells = random.integers(0, 2, (6, 6), dtype=np.uint8) * 255
                inner = max(side * 6 // 8, 6)
                patch = cv2.resize(cells, (inner, inner), interpolation=cv2.INTER_NEAREST)
                edge = (side - inner) // 2
                room = image[y + edge : y + edge + inner, x + edge : x + edge + inner]
                room[:] = patch[: room.shape[0], : room.shape[1]]
        false += len(detector.detect(image))
    print(
        f"\nFalse tags in {count} random pictures (half of them full of tag-like squares): {false}"
    )
    return {"random_pictures": float(count), "false_tags_in_random_pictures": float(false)}


def measure_renderer(frames: int) -> dict[str, float]:
    """Time the synthetic camera."""
    tags = TagMap.from_yaml(CONFIG / "tags.yaml")
    camera = SyntheticCamera(CameraModel.from_yaml(CONFIG / "synthetic_camera.yaml"), tags)
    room = camera.prepare()
    camera.frame(swing(tags, 0.0))
    ahead, times = [], []
    for k in range(frames):
        shape = swing(tags, k * PERIOD)
        started = time.process_time()
        camera.prepare(room)
        prepared = time.process_time()
        camera.frame(shape)
        times.append(time.process_time() - prepared)
        ahead.append(prepared - started)
    result = {
        "render_720p_cpu_ms": 1e3 * float(np.median(times)),
        "render_720p_ahead_cpu_ms": 1e3 * float(np.median(ahead)),
    }
    print(
        f"\nSynthetic camera, 1280 x 720: {result['render_720p_cpu_ms']:.2f} ms of CPU a picture, "
        f"and {result['render_720p_ahead_cpu_ms']:.2f} ms ahead of the shape"
    )
    return result


def run(quick: bool) -> dict[str, float | str]:
    """Measure everything; `quick` takes fewer pictures."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        result: dict[str, float | str] = {"opencv": cv2.__version__}
        result.update(measure_quality(1 if quick else 3))
        result.update(measure_fixed_tags(4, 3) if quick else measure_fixed_tags(12))
        result.update(measure_fast_limb(60 if quick else 150))
        result.update(measure_conditions(2 if quick else 3))
        scales: Sequence[tuple[float, str]] = ((1.0, "720p"), (1.5, "1080p"))
        for scale, name in scales:
            result.update(measure_sequence(45 if quick else 90, scale, name))
        result.update(measure_false_tags(100 if quick else 1000))
        result.update(measure_renderer(30 if quick else 150))
        result.update(measure_graph(8.0 if quick else 20.0))
        result.update(measure_ready_pictures(5.0 if quick else 15.0))
    finally:
        cv2.setNumThreads(threads)
    return result
