"""Draw the picture of docs/guide/tracker.md: python3 scripts/draw_figures.py tracker."""

from __future__ import annotations

import argparse

import cv2
import numpy as np

from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.reports import draw_observation
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.synthetic.shapes import Shape
from apriltag_tracker.tag_map import TagMap
from der_planner.twin import LimbTwin
from workspace_setup.basics import ROOT

PACKAGE = ROOT / "src" / "apriltag_tracker"


def main() -> int:
    """Bend the twin, photograph it, and draw in what the tracker sees."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
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
    path = ROOT / "docs" / "pictures" / "tracking.png"
    # Few grey levels keep the file small.
    cv2.imwrite(str(path), (small // 6) * 6, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(path, path.stat().st_size // 1000, "kB")
    return 0
