"""The default set-up, rendered."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from apriltag_tracker.detection import Detector
from apriltag_tracker.synthetic.camera import CameraModel, Optics, SyntheticCamera
from apriltag_tracker.tag_map import TagMap
from benchmarks.tracker import Swing

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


@pytest.fixture
def swing(tags: TagMap) -> Swing:
    return Swing(tags)
