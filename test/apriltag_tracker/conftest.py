"""The default set-up, rendered."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from apriltag_tracker.detection import Detector
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.synthetic.shapes import Shape, constant_curvature
from apriltag_tracker.tag_map import TagMap

CONFIG = Path(__file__).resolve().parents[2] / "src" / "apriltag_tracker" / "config"


@pytest.fixture(scope="session")
def config() -> Path:
    return CONFIG


@pytest.fixture(scope="session")
def tags() -> TagMap:
    return TagMap.from_yaml(CONFIG / "tags.yaml")


@pytest.fixture(scope="session")
def plain(tags: TagMap) -> TagMap:
    """The default tags on a limb without stiff stretches, on which arcs are exact."""
    return dataclasses.replace(tags, stiff=())


@pytest.fixture(scope="session")
def model() -> CameraModel:
    return CameraModel.from_yaml(CONFIG / "synthetic_camera.yaml")


@pytest.fixture(scope="session")
def camera(model: CameraModel, tags: TagMap) -> SyntheticCamera:
    return SyntheticCamera(model, tags, Optics(), seed=3)


@pytest.fixture(scope="session")
def detector() -> Detector:
    return Detector()


class Swing:
    """A limb that swings: its shape and velocity at any time."""

    def __init__(self, tags: TagMap, amplitude: float = 0.8) -> None:
        self.tags = tags
        self.amplitude = amplitude

    def shape(self, time: float) -> Shape:
        bends = [
            self.amplitude * np.sin(2.0 * np.pi * time / 3.0),
            self.amplitude * np.sin(2.0 * np.pi * time / 4.0),
        ]
        return constant_curvature(self.tags.segment_lengths, bends)

    def velocity(self, time: float) -> Shape:
        before, after = self.shape(time - 1e-3), self.shape(time + 1e-3)
        return Shape(
            before.arc_length,
            (after.points - before.points) / 2e-3,
            (after.heading - before.heading) / 2e-3,
        )


@pytest.fixture
def swing(tags: TagMap) -> Swing:
    return Swing(tags)
