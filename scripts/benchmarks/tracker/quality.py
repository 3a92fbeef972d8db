"""Tags found, corner errors and how honest the covariance is, on pictures by brute force.

The C library reads the same pictures in the same run. NEES / 8 is the squared error of a tag's
corners in units of the covariance that the tracker states, per number: 1 is honest, above is
overconfident.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import cv2
import numpy as np
import pyapriltags
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose
from apriltag_tracker.detection import Detector
from apriltag_tracker.family import TAG36H11, Family
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import CameraModel, Optics, Shape, SyntheticCamera
from apriltag_tracker.tag_map import TagMap
from benchmarks.tracker.pictures import CONFIG, PERIOD, swing
from benchmarks.tracker.renderer import Scene, render

SCENES = (
    Scene("sharp"),
    Scene("sharp_20px", pixels=20.0),
    Scene("sharp_45px", pixels=45.0),
    Scene("blur_1.5px", blur=1.5),
    Scene("defocus_2px", defocus=2.0),
    Scene("noise_12", noise=12.0),
    Scene("smear_3px", smear=3.0),
    Scene("smear_6px", smear=6.0),
    Scene("smear_7px", smear=7.0),
    Scene("smear_8px_50px", smear=8.0, pixels=50.0),
    Scene("turn_0.15rad", turn=0.15),
    Scene("rolling_shutter_2px", rolling=2.0),
    Scene("dark_0.12_20px", contrast=0.12, pixels=20.0),
    Scene("dark_0.12_30px", contrast=0.12),
    Scene("dark_0.12_45px", contrast=0.12, pixels=45.0),
    Scene("corner_covered_20px", corner=0.25, pixels=20.0),
    Scene("corner_covered_30px", corner=0.25),
    Scene("corner_covered_45px", corner=0.25, pixels=45.0),
    Scene("white_on_corner_20px", corner=0.25, pixels=20.0, cover=0.95),
    Scene("white_on_corner_30px", corner=0.25, cover=0.95),
    Scene("white_on_corner_45px", corner=0.25, pixels=45.0, cover=0.95),
)

_FIRST_SEED = 900
"""No threshold of the tracker was chosen on these pictures."""

_WRONG = 3.0
"""A tag whose corners are further off is a false one [px]."""


def measure_quality(pictures: int, family: Family = TAG36H11) -> dict[str, float]:
    """Print and return the table of all scenes.

    The C library takes 5 GB of memory for tagStandard52h13.
    """
    ours = Detector(family=family)
    theirs = pyapriltags.Detector(families=family.name, nthreads=1, quad_decimate=1.0)
    print(f"{'scene':22s} | found %: ours, C | corner RMS px: ours, C | NEES / 8 (median) | false")
    result: dict[str, float] = {}
    for scene in SCENES:
        asked, false, seen_by_c = 0, 0, 0
        gaps: list[NDArray[np.float64]] = []
        gaps_of_c: list[NDArray[np.float64]] = []
        honest = []
        for seed in range(_FIRST_SEED, _FIRST_SEED + pictures):
            image, truth = render(dataclasses.replace(scene, family=family), seed)
            asked += len(truth)
            for tag in ours.detect(image):
                gap = (tag.corners - truth[tag.id]).ravel() if tag.id in truth else None
                if gap is None or np.abs(gap).max() > _WRONG:
                    false += 1
                    continue
                gaps.append(gap)
                honest.append(float(gap @ np.linalg.solve(tag.covariance, gap)) / 8.0)
            for found in theirs.detect(image):
                # The C library counts pixels from their corners, we from their centres.
                place = np.asarray(found.corners) - 0.5
                if found.tag_id in truth and np.abs(place - truth[found.tag_id]).max() < _WRONG:
                    seen_by_c += 1
                    gaps_of_c.append((place - truth[found.tag_id]).ravel())
        row = {
            "found_percent": 100.0 * len(gaps) / asked,
            "c_found_percent": 100.0 * seen_by_c / asked,
            "corner_rms_px": _rms(gaps),
            "c_corner_rms_px": _rms(gaps_of_c),
            "nees": float(np.mean(honest)) if honest else float("nan"),
            "nees_median": float(np.median(honest)) if honest else float("nan"),
            "false": float(false),
        }
        result.update({f"quality_{scene.name}_{key}": value for key, value in row.items()})
        print(
            f"{scene.name:22s} | {row['found_percent']:6.1f} {row['c_found_percent']:6.1f}  | "
            f"{row['corner_rms_px']:8.4f} {row['c_corner_rms_px']:8.4f}      | "
            f"{row['nees']:6.2f} ({row['nees_median']:.2f})     | {false}",
            flush=True,
        )
    return result


def _rms(gaps: list[NDArray[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.square(gaps)))) if gaps else float("nan")


def measure_fixed_tags(seeds: int, frames: int = 151) -> dict[str, float]:
    """Say what each number of fixed tags gives: the tip, and its covariance, early and later.

    Every start has a camera of its own, a few millimetres and hundredths of a radian from the
    usual one: pixels are rounded elsewhere, and the lens bends the tags differently.
    """
    whole, usual = _set_up()
    print("\nfixed tags | pictures | tip RMS mm | NEES / 2 of the tip over many starts")
    result: dict[str, float] = {}
    order = (1, 4, 0, 3, 2, 5)
    spans = {"1 to 3": range(3), "28 to 30": range(27, 30), "149 to 151": range(148, 151)}
    for count in (1, 2, 3, 4, 6):
        tags = dataclasses.replace(whole, world=tuple(whole.world[k] for k in order[:count]))
        errors: dict[str, list[NDArray[np.float64]]] = {span: [] for span in spans}
        honest: dict[str, list[float]] = {span: [] for span in spans}
        for seed in range(seeds):
            model = CameraModel(usual.intrinsics, _moved_a_little(usual.pose, seed))
            camera = SyntheticCamera(model, tags, Optics(), seed=seed)
            tracker = LimbTracker(tags, model.intrinsics)
            for k in range(frames):
                shape = swing(tags, k * PERIOD + 0.3 * seed)
                estimate = tracker.observe(camera.frame(shape).image, k * PERIOD).estimate
                for span, pictures in spans.items():
                    if k in pictures and estimate is not None:
                        gap = estimate.tip - shape.points[-1]
                        errors[span].append(gap)
                        nees = gap @ np.linalg.solve(estimate.tip_covariance, gap) / 2.0
                        honest[span].append(float(nees))
        for span in spans:
            if not errors[span]:
                continue
            rms, nees = 1e3 * _rms(errors[span]) * np.sqrt(2.0), float(np.mean(honest[span]))
            name = f"fixed_{count}_pictures_{span.replace(' ', '_')}"
            result.update({f"{name}_tip_rms_mm": float(rms), f"{name}_nees": nees})
            print(f"{count:10d} | {span:>10s} | {rms:10.4f} | {nees:.2f}", flush=True)
    return result


def _moved_a_little(pose: CameraPose, seed: int) -> CameraPose:
    """Return a camera that was mounted anew, by a few millimetres and hundredths of a radian."""
    random = np.random.default_rng(seed)
    turn = cv2.Rodrigues(random.normal(0.0, 0.01, 3))[0]
    shift = random.normal(0.0, 0.004, 3)
    return CameraPose(turn @ pose.rotation, turn @ pose.translation + shift)


def measure_fast_limb(frames: int) -> dict[str, float]:
    """Follow a limb whose tip goes at 2.2 m/s with 3 ms of exposure."""
    tags, model = _set_up()
    camera = SyntheticCamera(model, tags, Optics(exposure=0.003), seed=2)
    # The tip of two segments of 0.8 rad each at this rate reaches 2.2 m/s.
    speed = 2.2 / _fastest(tags)
    limb = LimbTracker(tags, model.intrinsics)
    asked = found = 0
    errors, times = [], []
    for k in range(frames):
        moment = speed * k * PERIOD
        shape, later = swing(tags, moment), swing(tags, moment + 1e-4)
        velocity = Shape(
            shape.arc_length,
            (later.points - shape.points) / 1e-4 * speed,
            (later.heading - shape.heading) / 1e-4 * speed,
        )
        frame = camera.frame(shape, velocity)
        inside = {tag.id for tag in tags.limb} & frame.corners.keys()
        started = time.process_time()
        observation = limb.observe(frame.image, k * PERIOD)
        times.append(time.process_time() - started)
        asked += len(inside)
        found += len(inside & {placed.tag.id for placed in observation.tags})
        if observation.estimate is not None:
            errors.append(observation.estimate.tip - shape.points[-1])
    off = 1e3 * np.hypot(*np.array(errors).T)
    result = {
        "fast_limb_found_percent": 100.0 * found / asked,
        "fast_limb_tip_rms_mm": float(np.sqrt(np.mean(off**2))),
        "fast_limb_tip_p99_mm": float(np.percentile(off, 99)),
        "fast_limb_valid_percent": 100.0 * len(errors) / frames,
        "fast_limb_image_to_tip_median_cpu_ms": 1e3 * float(np.median(times)),
        "fast_limb_image_to_tip_p99_cpu_ms": 1e3 * float(np.percentile(times, 99)),
    }
    print("\nA limb whose tip goes at 2.2 m/s, 3 ms of exposure, 30 pictures a second", flush=True)
    for key, value in result.items():
        print(f"  {key:42s} {value:9.3f}")
    return result


def _set_up() -> tuple[TagMap, CameraModel]:
    """Return the default tags on a limb that bends everywhere, and the default camera."""
    config: Path = CONFIG
    tags = dataclasses.replace(TagMap.from_yaml(config / "tags.yaml"), stiff=())
    return tags, CameraModel.from_yaml(config / "synthetic_camera.yaml")


def _fastest(tags: TagMap) -> float:
    """Return the largest speed of the tip over one cycle of the swing [m/s]."""
    moments = np.arange(0.0, 12.0, 0.01)
    tips = np.array([swing(tags, moment).points[-1] for moment in moments])
    return float(np.hypot(*np.diff(tips, axis=0).T).max() / 0.01)
