"""A camera that is not there: it renders the limb with its tags and the fixed tags around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraError, CameraPose, Intrinsics, project
from apriltag_tracker.synthetic import render
from apriltag_tracker.synthetic.shapes import (
    MOST_INSTANTS,
    Mounts,
    Placements,
    Shape,
    place_tags,
)
from apriltag_tracker.tag_map import LimbTag, TagMap, WorldTag

SCHEMA_VERSION = 1
_BODY_RADIUS = 0.013
"""Half the width of the limb [m]."""
_NOISE_LENGTH = 1 << 21


@dataclass(frozen=True)
class Optics:
    """How good the pictures are.

    Attributes:
        noise: standard deviation of a pixel [grey levels].
        blur: standard deviation of the lens's blur [px].
        exposure: time a picture takes [s]; motion during it blurs.
        black: grey level of printed black in nominal light.
        white: grey level of paper in nominal light.
        light_fall: by how much the light differs over the picture, as a share of its mean.
    """

    noise: float = 2.0
    blur: float = 0.6
    exposure: float = 0.004
    black: float = 28.0
    white: float = 205.0
    light_fall: float = 0.25


@dataclass
class CameraModel:
    """Where the rendered camera is and what its lens does."""

    intrinsics: Intrinsics
    pose: CameraPose

    @classmethod
    def from_yaml(cls, path: str | Path) -> CameraModel:
        """Read `synthetic_camera.yaml`.

        Raises:
            CameraError: the file is missing, or a key is missing or impossible.
        """
        try:
            data = yaml.safe_load(Path(path).read_text())
            if data["schema"] != SCHEMA_VERSION:
                raise CameraError(f"{path}: 'schema: {SCHEMA_VERSION}' expected")
            f = float(data["focal_length"])
            cx, cy = (float(value) for value in data["principal_point"])
            intrinsics = Intrinsics.create(
                int(data["width"]),
                int(data["height"]),
                [f, 0.0, cx, 0.0, f, cy, 0.0, 0.0, 1.0],
                data["distortion"],
            )
            x, y, z = (float(value) for value in data["position"])
            tilt = (float(data["tilt"][0]), float(data["tilt"][1]))
            pose = CameraPose.looking_down((x, y, z), float(data["turn"]), tilt)
        except OSError as error:
            raise CameraError(f"cannot read the camera {path}: {error.strerror}") from error
        except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
            raise CameraError(f"{path} does not describe a camera: {error}") from error
        return cls(intrinsics, pose)


@dataclass
class RenderedPicture:
    """One picture and the truth about it.

    Attributes:
        image: (rows, columns) grey.
        corners: true corners (4, 2) px of every tag in the picture, by id, at mid-exposure.
    """

    image: NDArray[np.uint8]
    corners: dict[int, NDArray[np.float64]]


class SyntheticCamera:
    """Renders frames of a limb.

    Args:
        model: lens and place of the camera.
        tags: where the tags are.
        optics: picture quality.
        seed: of noise and floor.
    """

    def __init__(
        self,
        model: CameraModel,
        tags: TagMap,
        optics: Optics | None = None,
        seed: int = 0,
    ) -> None:
        self.model = model
        self.tags = tags
        self.optics = optics or Optics()
        self._random = np.random.default_rng(seed)
        self._eye = self._make_eye()
        self._scale = model.intrinsics.matrix[0, 0] / model.pose.position[2]
        self._prints = self._print(tags.limb)
        self._noise = self._make_noise()
        # Saturated sums of bytes take a quarter of the time of a sum of bytes and signed noise.
        self._brighter = np.maximum(self._noise, 0).astype(np.uint8)
        self._darker = np.maximum(-self._noise, 0).astype(np.uint8)
        self._mounts = Mounts(
            np.array([tag.arc_length for tag in tags.limb]),
            np.array([tag.height for tag in tags.limb]),
            np.array([tag.size for tag in tags.limb]),
            np.array([tag.offset for tag in tags.limb]),
        )
        self._background, self._world = self._make_background()
        self._noise_starts = np.zeros(len(tags.limb), dtype=np.int64)

    def frame(self, shape: Shape, velocity: Shape | None = None) -> RenderedPicture:
        """Render one picture.

        Args:
            shape: the limb at mid-exposure.
            velocity: the shape one second later at the present velocity minus the shape itself, in
                the same arrays; blurs what moves.
        """
        rows, columns = self._background.shape
        start = int(self._random.integers(0, _NOISE_LENGTH - rows * columns))
        self._noise_starts = self._random.integers(0, _NOISE_LENGTH, len(self._noise_starts))
        noise = np.s_[start : start + rows * columns]
        image = np.empty((rows, columns), dtype=np.uint8)
        cv2.add(self._background, self._brighter[noise].reshape(rows, columns), image)
        cv2.subtract(image, self._darker[noise].reshape(rows, columns), image)
        self._draw_body(image, shape)
        placed = place_tags(self._mounts, self.optics.exposure, self._scale, shape, velocity)
        drawn = self._draw_tags(image, self.tags.limb, self._prints, self._noise, placed)
        return RenderedPicture(image, self._world | drawn)

    def _draw_tags(
        self,
        image: NDArray[np.uint8],
        tags: Sequence[LimbTag | WorldTag],
        prints: render.Prints,
        noise: NDArray[np.int8],
        placed: Placements,
    ) -> dict[int, NDArray[np.float64]]:
        """Draw placed tags; returns the corners of those that are in the picture, by id."""
        starts = self._noise_starts if len(noise) > 1 else np.zeros(len(tags), dtype=np.int64)
        corners, drawn = render.draw_tags(image, self._eye, prints, noise, starts, placed)
        return {tag.id: corners[k] for k, tag in enumerate(tags) if drawn[k]}

    def _draw_body(self, image: NDArray[np.uint8], shape: Shape) -> None:
        """Draw the limb's silhouette: dark silicone at half the height of its tags."""
        height = 0.5 * max(tag.height for tag in self.tags.limb)
        normal = np.stack([-np.sin(shape.heading), np.cos(shape.heading)], axis=1)
        left = shape.points + _BODY_RADIUS * normal
        right = shape.points - _BODY_RADIUS * normal
        outline = np.vstack([left, right[::-1]])
        points = np.column_stack([outline, np.full(len(outline), height)])
        pixels = project(self.model.intrinsics, self.model.pose, points)
        fixed = np.round(pixels * 16).astype(np.int32)
        cv2.fillPoly(image, [fixed], 52, cv2.LINE_AA, 4)

    def _make_eye(self) -> render.Eye:
        """Return lens, place and light as the drawing takes them."""
        size, pose = self.model.intrinsics, self.model.pose
        rows, columns = np.indices((size.height, size.width))
        rays = size.rays(np.stack([columns, rows], axis=2)).reshape(*rows.shape, 2)
        return render.Eye(
            np.ascontiguousarray(pose.rotation),
            np.ascontiguousarray(pose.translation),
            size.matrix,
            size.distortion,
            rays.astype(np.float32),
            self._make_light(),
            math.sqrt(self.optics.blur**2 + render.PIXEL_VARIANCE),
            self.optics.black,
            self.optics.white,
            render.cumulative_table(),
        )

    def _print(self, tags: Sequence[LimbTag | WorldTag]) -> render.Prints:
        family = self.tags.family
        cells = np.array([family.printed_cells(tag.id) for tag in tags], dtype=np.float64)
        return render.Prints(cells, float(family.border_cells))

    def _make_light(self) -> NDArray[np.float32]:
        size = self.model.intrinsics
        y, x = np.mgrid[0 : size.height, 0 : size.width].astype(np.float32)
        x, y = x / size.width - 0.5, y / size.width - 0.5 * size.height / size.width
        field_ = 0.6 * x - 0.4 * y - 1.2 * (x * x + y * y)
        field_ -= field_.mean()
        return np.ascontiguousarray(1.0 + self.optics.light_fall * field_, dtype=np.float32)

    def _make_noise(self) -> NDArray[np.int8]:
        drawn = self._random.standard_normal(_NOISE_LENGTH, dtype=np.float32) * self.optics.noise
        return np.clip(np.round(drawn), -127, 127).astype(np.int8)

    def _make_background(self) -> tuple[NDArray[np.uint8], dict[int, NDArray[np.float64]]]:
        """Draw what does not move, without noise: a cloudy floor and the fixed tags.

        Returns:
            The picture, and the corners of the fixed tags in it by id.
        """
        size = self.model.intrinsics
        coarse = self._random.standard_normal((size.height // 40 + 2, size.width // 40 + 2))
        clouds = cv2.resize(
            coarse.astype(np.float32), (size.width, size.height), interpolation=cv2.INTER_CUBIC
        )
        floor = (120.0 + 6.0 * clouds) * self._eye.light
        image: NDArray[Any] = np.clip(np.round(floor), 0, 255).astype(np.uint8)
        if not self.tags.world:
            return image, {}
        world = np.array([(*tag.position, tag.yaw, tag.size) for tag in self.tags.world])
        instants = np.repeat(world[:, None], MOST_INSTANTS, axis=1)
        still = Placements(world, instants, np.ones(len(world), dtype=np.int64))
        tags, silent = self.tags.world, np.zeros(1, dtype=np.int8)
        corners = self._draw_tags(image, tags, self._print(tags), silent, still)
        return image, corners
