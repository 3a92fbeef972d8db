"""The tracker's figures, beside the AprilTag 3 C library (`pyapriltags`) on the same pictures.

Every picture is rendered in closed form with known corners. Both detectors run in one thread; times
are CPU times, which other programs on the machine change little.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pyapriltags
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.detection import Detector
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import (
    CameraModel,
    Frame,
    Optics,
    Shape,
    SyntheticCamera,
)
from apriltag_tracker.synthetic.shapes import constant_curvature
from apriltag_tracker.tag_map import LimbTag, TagMap, WorldTag
from apriltag_tracker.tracking import TagTracker
from benchmarks.tracker_graph import measure_graph

CONFIG = Path(__file__).resolve().parents[2] / "src" / "apriltag_tracker" / "config"
_SIZE = 0.02
_HEIGHT = 0.5
_PERIOD = 1.0 / 30.0


@dataclass(frozen=True)
class Condition:
    """How the pictures of one row are made."""

    name: str
    pixels: float = 30.0
    blur: float = 0.6
    noise: float = 2.0
    light_fall: float = 0.25
    speed: float = 0.0  # px that the tags travel during the exposure
    cover: float = 0.0  # share of one side that is covered
    contrast: float = 1.0


CONDITIONS = (
    Condition("size_14px", pixels=14.0, blur=0.5),
    Condition("size_18px", pixels=18.0, blur=0.5),
    Condition("size_22px", pixels=22.0),
    Condition("size_30px"),
    Condition("size_45px", pixels=45.0),
    Condition("blur_1.0px", blur=1.0),
    Condition("blur_1.5px", blur=1.5),
    Condition("noise_6", noise=6.0),
    Condition("noise_12", noise=12.0),
    Condition("motion_2px", speed=2.0),
    Condition("motion_4px", speed=4.0),
    Condition("dim_light", contrast=0.25),
    Condition("uneven_light", light_fall=1.2),
    Condition("covered_15pc", cover=0.15),
)


def tag_field(
    condition: Condition, seed: int, width: int = 1280, height: int = 720
) -> SyntheticCamera:
    """Return a camera over a limb tag grid: tags in all directions, all on the moving limb."""
    random = np.random.default_rng(seed)
    focal = condition.pixels / _SIZE * _HEIGHT
    pitch = max(1.9 * _SIZE, 60.0 / focal * _HEIGHT)
    reach = 0.5 * np.array([width, height]) / focal * _HEIGHT - 1.1 * _SIZE
    columns, rows = (int(min(np.floor(2.0 * reach[k] / pitch) + 1, (8, 5)[k])) for k in (0, 1))
    world = []
    for k in range(columns * rows):
        x = (k % columns - 0.5 * (columns - 1)) * pitch
        y = (k // columns - 0.5 * (rows - 1)) * pitch
        shake = random.uniform(-0.1, 0.1, 2) * _SIZE
        yaw = float(random.uniform(-np.pi, np.pi))
        world.append(WorldTag(k, (x + shake[0], y + shake[1], 0.0), yaw, _SIZE))
    tags = TagMap((0.1,), (LimbTag(500, 0.05, 0.0, _SIZE),), tuple(world))
    matrix = [focal, 0.0, 0.5 * width, 0.0, focal, 0.5 * height, 0.0, 0.0, 1.0]
    lens = Intrinsics.create(width, height, matrix, [-0.08, 0.03, 0.0, 0.0])
    pose = CameraPose.looking_down((0.0, 0.0, _HEIGHT), 0.0, (0.02, -0.03))
    black, white = 28.0 * condition.contrast, 205.0 * condition.contrast
    optics = Optics(
        noise=condition.noise,
        blur=condition.blur,
        light_fall=condition.light_fall,
        black=black,
        white=white,
        floor=120.0 * condition.contrast,
    )
    return SyntheticCamera(CameraModel(lens, pose), tags, optics, seed=seed)


def picture(camera: SyntheticCamera, condition: Condition) -> Frame:
    """Render one picture; motion smears it along x, covers hide a share of a side of every tag."""
    covers = []
    plain = camera.frame(None)
    if condition.cover > 0.0:
        for corners in plain.corners.values():
            a, b, _, d = corners
            start, end = a + 0.4 * (b - a), a + (0.4 + condition.cover) * (b - a)
            out = (a - d) / np.linalg.norm(a - d)
            covers.append([start + 5 * out, end + 5 * out, end - 2 * out, start - 2 * out])
    frame = camera.frame(None, covers=covers)
    if condition.speed > 0.0:
        # The mean of sharp pictures along the way, by a box filter with fractional ends.
        frame.image = _smear(camera, condition.speed)
    return frame


def _smear(camera: SyntheticCamera, travel: float) -> NDArray[np.uint8]:
    rows, columns = camera.frame(None).image.shape
    fine = 8
    count = round(travel * fine)
    still = camera.still()
    wide = cv2.resize(still, (columns * fine, rows), interpolation=cv2.INTER_LINEAR)
    smeared = cv2.blur(wide, (count | 1, 1))
    # A pixel of the enlarged picture lies at (k + 0.5) / fine - 0.5 of the original.
    low = smeared[:, fine // 2 - 1 :: fine].astype(np.float32)
    high = smeared[:, fine // 2 :: fine].astype(np.float32)
    noise = np.random.default_rng(7).normal(0.0, camera.optics.noise, still.shape)
    return np.clip(np.round(0.5 * (low + high) + noise), 0, 255).astype(np.uint8)


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
    detector.warm_up()
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


def _swing(tags: TagMap, moment: float) -> Shape:
    bends = [
        0.8 * np.sin(2.0 * np.pi * moment / 3.0),
        0.8 * np.sin(2.0 * np.pi * moment / 4.0),
    ]
    return constant_curvature(tags.segment_lengths, bends)


def swinging_limb(frames: int, scale: float) -> tuple[TagMap, CameraModel, list[Frame], NDArray]:
    """Render a limb that swings; `scale` 1 is 720p and 1.5 is 1080p with the same view."""
    mapped = TagMap.from_yaml(CONFIG / "tags.yaml")
    tags = TagMap(mapped.segment_lengths, mapped.limb, mapped.world)
    model = CameraModel.from_yaml(CONFIG / "synthetic_camera.yaml")
    lens = model.intrinsics
    matrix = lens.matrix.copy()
    matrix[:2] *= scale
    matrix[:2, 2] += 0.5 * scale - 0.5
    size = (round(lens.width * scale), round(lens.height * scale))
    model = CameraModel(Intrinsics.create(*size, matrix, lens.distortion), model.pose)
    camera = SyntheticCamera(model, tags, Optics())
    pictures, tips = [], []
    for k in range(frames):
        moment = k * _PERIOD
        shape, later = _swing(tags, moment), _swing(tags, moment + 1e-3)
        velocity = Shape(
            shape.arc_length,
            (later.points - shape.points) / 1e-3,
            (later.heading - shape.heading) / 1e-3,
        )
        pictures.append(camera.frame(shape, velocity))
        tips.append(shape.points[-1])
    return tags, model, pictures, np.array(tips)


def measure_sequence(frames: int, scale: float, name: str) -> dict[str, float]:
    """Track a swinging limb and search every picture with the C library."""
    tags, model, pictures, tips = swinging_limb(frames, scale)
    detector = Detector(smallest=14.0)
    detector.warm_up()
    tracker = TagTracker(tags.ids, detector)
    tracked, full = Score([], []), Score([], [])
    times, kinds = [], []
    for k, frame in enumerate(pictures):
        before = tracker.counts.full_searches
        started = time.process_time()
        found = tracker.track(frame.image, k * _PERIOD)
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
        observation = limb.observe(frame.image, k * _PERIOD)
        whole.append(time.process_time() - started)
        if observation.estimate is not None and not observation.bridged:
            tip_errors.append(observation.estimate.tip - tip)
    peers = {}
    for decimate in (1.0, 2.0):
        detect, score = c_library(decimate), Score([], [])
        for frame in pictures:
            started = time.process_time()
            found_by_peer = detect(frame.image)
            score.seconds += time.process_time() - started
            score.add(frame.corners, found_by_peer)
        peers[f"c_decimate_{decimate:.0f}"] = score.figures()
    only = np.array(times)[~np.array(kinds)]
    result = {
        "tracked_frame_median_cpu_ms": 1e3 * float(np.median(only)),
        "tracked_frame_p99_cpu_ms": 1e3 * float(np.percentile(only, 99)),
        "full_search_cpu_ms": full.figures()["cpu_ms_a_picture"],
        "image_to_limb_median_cpu_ms": 1e3 * float(np.median(whole)),
        "image_to_limb_mean_cpu_ms": 1e3 * float(np.mean(whole)),
        "tracked_detected_percent": tracked.figures()["detected_percent"],
        "tracked_corner_rms_px": tracked.figures()["corner_rms_px"],
        "full_corner_rms_px": full.figures()["corner_rms_px"],
        "tip_rms_mm": 1e3 * float(np.sqrt(np.mean(np.sum(np.square(tip_errors), axis=1)))),
        "tip_max_mm": 1e3 * float(np.hypot(*np.array(tip_errors).T).max()),
        "valid_percent": 100.0 * len(tip_errors) / len(pictures),
    }
    for peer, figures in peers.items():
        result.update({f"{peer}_{key}": value for key, value in figures.items()})
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
    camera.frame(_swing(tags, 0.0))
    times = []
    for k in range(frames):
        shape = _swing(tags, k * _PERIOD)
        started = time.process_time()
        camera.frame(shape)
        times.append(time.process_time() - started)
    milliseconds = 1e3 * float(np.median(times))
    print(f"\nSynthetic camera, 1280 x 720: {milliseconds:.2f} ms of CPU a picture")
    return {"render_720p_cpu_ms": milliseconds}


def run(quick: bool) -> dict[str, float | str]:
    """Measure everything; `quick` takes fewer pictures."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        result: dict[str, float | str] = {"opencv": cv2.__version__}
        result.update(measure_conditions(2 if quick else 6))
        scales: Sequence[tuple[float, str]] = ((1.0, "720p"), (1.5, "1080p"))
        for scale, name in scales:
            result.update(measure_sequence(45 if quick else 150, scale, name))
        result.update(measure_false_tags(100 if quick else 1000))
        result.update(measure_renderer(30 if quick else 150))
        result.update(measure_graph(8.0 if quick else 30.0))
    finally:
        cv2.setNumThreads(threads)
    return result
