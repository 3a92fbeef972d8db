"""Draw the pictures of src/apriltag_tracker/README.md.

python3 scripts/benchmark.py tracker --json figures.json
python3 scripts/draw_figures.py tracker --figures figures.json
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from apriltag_tracker.overlay import draw_observation
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.synthetic.camera import (
    CameraModel,
    Optics,
    Shape,
    SyntheticCamera,
)
from apriltag_tracker.tag_map import TagMap
from benchmarks.tracker.pictures import CONDITIONS
from der_planner.results.outputs import folder_argument
from der_planner.twin import LimbTwin
from workspace_setup.basics import ROOT

matplotlib.use("Agg")

PACKAGE = ROOT / "src" / "apriltag_tracker"
DETECTORS = {
    "ours": "this package",
    "c_decimate_1": "AprilTag 3 C library, quad_decimate=1",
    "c_decimate_2": "AprilTag 3 C library, quad_decimate=2",
}


def draw_frame(path: Path) -> None:
    """Bend the twin, photograph it, and draw in what the tracker sees."""
    tags = TagMap.from_yaml(PACKAGE / "config" / "tags.yaml")
    model = CameraModel.from_yaml(PACKAGE / "config" / "synthetic_camera.yaml")
    twin = LimbTwin(0)
    twin.step(101325.0 + np.array([9e3, 0.0, 13e3, 0.0]), 6.0)
    shape = twin.shape()
    seen = Shape(shape.arc_length, shape.points, shape.heading)
    image = SyntheticCamera(model, tags, Optics(noise=0.0)).frame(seen).image
    tracker = LimbTracker(tags, model.intrinsics)
    picture = draw_observation(image, tracker.observe(image, 0.0), tracker)
    small = cv2.resize(picture, (960, 540), interpolation=cv2.INTER_AREA)
    # Few grey levels keep the file small.
    cv2.imwrite(str(path), (small // 6) * 6, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(path, path.stat().st_size // 1000, "kB")


def draw_accuracy(figures: dict[str, float], path: Path) -> None:
    """Compare corner errors and detection rates under every condition of the benchmark."""
    names = [condition.name for condition in CONDITIONS]
    place = np.arange(len(names))
    figure, axes = plt.subplots(2, 1, figsize=(9, 5.5), sharex=True, height_ratios=(2, 1))
    for k, (key, label) in enumerate(DETECTORS.items()):
        left = place + (k - 1) * 0.27
        axes[0].bar(left, [figures[f"{n}_{key}_corner_rms_px"] for n in names], 0.26, label=label)
        axes[1].bar(left, [figures[f"{n}_{key}_detected_percent"] for n in names], 0.26)
    axes[0].set_yscale("log")
    axes[0].set_ylabel("corner error, RMS [px]")
    axes[0].legend(frameon=False)
    axes[1].set_ylabel("tags found [%]")
    axes[1].set_xticks(place, [name.replace("_", " ") for name in names], rotation=40, ha="right")
    for axis in axes:
        axis.grid(axis="y", alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    print(path, path.stat().st_size // 1000, "kB")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--figures", type=Path, help="JSON of scripts/benchmark.py tracker")
    parser.add_argument("--out", type=folder_argument, default=PACKAGE / "doc", metavar="DIR")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    draw_frame(options.out / "tracking.png")
    if options.figures is not None:
        figures = json.loads(options.figures.read_text())["tracker"]
        draw_accuracy(figures, options.out / "accuracy.png")
    return 0
