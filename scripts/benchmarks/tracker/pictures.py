"""Pictures with known tags, for the tracker's benchmark: grids of tags and a limb that swings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.synthetic.camera import CameraModel, Frame, Optics, Shape, SyntheticCamera
from apriltag_tracker.synthetic.shapes import constant_curvature
from apriltag_tracker.tag_map import LimbTag, TagMap, WorldTag

CONFIG = Path(__file__).resolve().parents[3] / "src" / "apriltag_tracker" / "config"
_SIZE = 0.02
_HEIGHT = 0.5
PERIOD = 1.0 / 30.0


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


def swing(tags: TagMap, moment: float) -> Shape:
    """Return the limb at a moment [s]: each segment swings at its own period."""
    bends = [
        0.8 * np.sin(2.0 * np.pi * moment / 3.0),
        0.8 * np.sin(2.0 * np.pi * moment / 4.0),
    ]
    return constant_curvature(tags.segment_lengths, bends)


def swinging_limb(
    frames: int, scale: float
) -> tuple[TagMap, CameraModel, list[Frame], NDArray[np.float64]]:
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
        moment = k * PERIOD
        shape, later = swing(tags, moment), swing(tags, moment + 1e-3)
        velocity = Shape(
            shape.arc_length,
            (later.points - shape.points) / 1e-3,
            (later.heading - shape.heading) / 1e-3,
        )
        pictures.append(camera.frame(shape, velocity))
        tips.append(shape.points[-1])
    return tags, model, pictures, np.array(tips)
