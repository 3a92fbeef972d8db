"""A camera that is not there: it renders the limb with its tags and the fixed tags around it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraError, CameraPose, Intrinsics, project
from apriltag_tracker.camera.lens import ray_map
from apriltag_tracker.synthetic import render
from apriltag_tracker.tag_map import UNIT_CORNERS, TagMap

SCHEMA_VERSION = 1
_NOISE_LENGTH = 1 << 21
_STILL, _INSTANTS_APART, _MOST_INSTANTS = 0.2, 1.1, 16
"""Ways during an exposure that are shorter than the first [px] are one instant; longer ones take
Gauss's instants, about so far apart [px]: of a blurred picture their mean is that of all."""


_gauss = lru_cache(np.polynomial.legendre.leggauss)


@dataclass(frozen=True)
class Optics:
    """How good the pictures are.

    Attributes:
        noise: standard deviation of a pixel [grey levels].
        blur: standard deviation of the lens's blur [px].
        exposure: time a picture takes [s]; motion during it blurs.
        black: grey level of printed black in nominal light.
        white: grey level of paper in nominal light.
        floor: grey level of the base plane.
        light_fall: by how much the light differs over the picture, as a share of its mean.
    """

    noise: float = 2.0
    blur: float = 0.6
    exposure: float = 0.004
    black: float = 28.0
    white: float = 205.0
    floor: float = 120.0
    light_fall: float = 0.25


@dataclass(frozen=True)
class Errors:
    """How far the set-up is from what the tag map says, drawn from the seed; zero by default.

    Attributes:
        survey: standard deviation of the world tags' positions [m].
        mounting: standard deviation of the limb tags' positions on the limb [m].
        mounting_angle: standard deviation of the limb tags' directions [rad].
    """

    survey: float = 0.0
    mounting: float = 0.0
    mounting_angle: float = 0.0


@dataclass(frozen=True)
class Shape:
    """A centreline in the plane: arc length (n,) m, points (n, 2) m and heading (n,) rad."""

    arc_length: NDArray[np.float64]
    points: NDArray[np.float64]
    heading: NDArray[np.float64]

    def at(self, arc_length: float) -> NDArray[np.float64]:
        """Return x, y, heading at an arc length (cubic), continued as a line beyond."""
        s = self.arc_length
        k = int(np.clip(np.searchsorted(s, arc_length) - 1, 0, len(s) - 2))
        step = s[k + 1] - s[k]
        share = (arc_length - s[k]) / step
        chord = self.points[k + 1] - self.points[k]
        turned = self.heading[k + 1] - self.heading[k]
        heading = self.heading[k] + share * turned
        if share < 0.0 or share > 1.0:
            end, angle = (0, self.heading[0]) if share < 0.0 else (-1, self.heading[-1])
            reach = arc_length - s[end]
            place = self.points[end] + reach * np.array([np.cos(angle), np.sin(angle)])
            return np.array([place[0], place[1], angle])
        # Hermite: the tangents are known, their length is that of the chord's arc.
        half = 0.5 * turned
        arc = float(np.hypot(*chord)) * (1.0 + half * half / 6.0)
        first = arc * np.array([np.cos(self.heading[k]), np.sin(self.heading[k])])
        second = arc * np.array([np.cos(self.heading[k + 1]), np.sin(self.heading[k + 1])])
        t = share
        place = (
            self.points[k]
            + chord * (3 * t**2 - 2 * t**3)
            + first * (t - 2 * t**2 + t**3)
            + second * (t**3 - t**2)
        )
        return np.array([place[0], place[1], heading])


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
class Frame:
    """One picture and the truth about it.

    Attributes:
        image: (rows, columns) grey.
        corners: true corners (4, 2) px of every tag in the picture, by id, at mid-exposure.
    """

    image: NDArray[np.uint8]
    corners: dict[int, NDArray[np.float64]] = field(default_factory=dict)


class SyntheticCamera:
    """Renders frames of a limb.

    Args:
        model: lens and place of the camera.
        tags: where the tags are.
        optics: picture quality.
        errors: differences between the tag map and the set-up.
        seed: of noise, floor and errors.
        body_radius: half the width of the limb [m].
    """

    def __init__(
        self,
        model: CameraModel,
        tags: TagMap,
        optics: Optics | None = None,
        errors: Errors | None = None,
        seed: int = 0,
        body_radius: float = 0.013,
    ) -> None:
        self.model = model
        self.tags = tags
        self.optics = optics or Optics()
        self.errors = errors or Errors()
        self.body_radius = body_radius
        self._random = np.random.default_rng(seed)
        size = model.intrinsics
        self._rays = ray_map(size.width, size.height, size.matrix, size.distortion)
        self._table = render.cumulative_table()
        self._cells = {tag: tags.family.printed_cells(tag) for tag in tags.ids}
        self._light = self._make_light()
        self._noise = self._make_noise()
        # Saturated sums of bytes take a quarter of the time of a sum of bytes and signed noise.
        self._brighter = np.maximum(self._noise, 0).astype(np.uint8)
        self._darker = np.maximum(-self._noise, 0).astype(np.uint8)
        self._mounting = self._draw_mounting()
        self._world = self._draw_world()
        self._background = self._make_background()

    def frame(
        self,
        shape: Shape | None,
        velocity: Shape | None = None,
        covers: Sequence[Sequence[tuple[float, float]]] = (),
    ) -> Frame:
        """Render one picture.

        Args:
            shape: the limb at mid-exposure; None leaves it out.
            velocity: the shape one second later at the present velocity minus the shape itself, in
                the same arrays; blurs what moves.
            covers: polygons (px) that hide what is below them, drawn last.
        """
        shape_of, count = self._background.shape, self._background.size
        start = int(self._random.integers(0, _NOISE_LENGTH - count))
        brighter = self._brighter[start : start + count].reshape(shape_of)
        darker = self._darker[start : start + count].reshape(shape_of)
        image = cv2.subtract(cv2.add(self._background, brighter), darker)
        result = Frame(image, {tag: corners for tag, (corners, _) in self._world.items()})
        if shape is not None:
            self._draw_body(image, shape)
            for tag in self.tags.limb:
                middle, placements, shares = self._placements(tag.id, shape, velocity)
                if self._draw_tag(image, tag.id, placements, shares):
                    result.corners[tag.id] = self._corners(middle)
        for polygon in covers:
            points = np.round(np.array(polygon) * 16).astype(np.int32)
            cv2.fillPoly(image, [points], 70, cv2.LINE_AA, 4)
        return result

    def still(self) -> NDArray[np.uint8]:
        """Return what does not move, without noise."""
        return self._background.copy()

    def _placements(
        self, tag_id: int, shape: Shape, velocity: Shape | None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return x, y, z, yaw, size of a limb tag in the middle, (5,), and over the exposure.

        The latter are (k, 5), each with the share (k,) of the exposure that it stands for.
        """
        tag = self.tags.limb_tag(tag_id)
        assert tag is not None
        offset = self._mounting[tag_id]
        scale = self.model.intrinsics.matrix[0, 0] / self.model.pose.position[2]

        def place(at: NDArray[np.float64]) -> NDArray[np.float64]:
            cosine, sine = np.cos(at[2]), np.sin(at[2])
            return np.array(
                [
                    at[0] + cosine * offset[0] - sine * offset[1],
                    at[1] + sine * offset[0] + cosine * offset[1],
                    tag.height,
                    at[2] + offset[2],
                    tag.size,
                ]
            )

        now = shape.at(tag.arc_length)
        if velocity is None or self.optics.exposure <= 0.0:
            return place(now), place(now)[None], np.ones(1)
        later = Shape(
            shape.arc_length, shape.points + velocity.points, shape.heading + velocity.heading
        )
        rate = later.at(tag.arc_length) - now
        half = 0.5 * self.optics.exposure
        travelled = 2.0 * half * scale * (np.hypot(rate[0], rate[1]) + abs(rate[2]) * tag.size)
        if travelled < _STILL:
            return place(now), place(now)[None], np.ones(1)
        instants = min(1 + math.ceil(travelled / _INSTANTS_APART), _MOST_INSTANTS)
        nodes, weights = _gauss(instants)
        placements = np.array([place(now + rate * half * node) for node in nodes])
        return place(now), placements, 0.5 * weights

    def _corners(self, placement: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z, yaw, size = placement
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        points = np.empty((4, 3))
        points[:, :2] = UNIT_CORNERS @ turn * size + (x, y)
        points[:, 2] = z
        return project(self.model.intrinsics, self.model.pose, points)

    def _draw_tag(
        self,
        image: NDArray[np.uint8],
        tag_id: int,
        placements: NDArray[np.float64],
        shares: NDArray[np.float64],
    ) -> bool:
        """Draw a tag over an exposure; returns whether any of it is in the picture."""
        first, last = self._corners(placements[0]), self._corners(placements[-1])
        both = np.concatenate([first, last])
        middle = both.mean(axis=0)
        family = self.tags.family
        grown = middle + (both - middle) * (family.tag_cells / family.border_cells)
        blur = np.sqrt(self.optics.blur**2 + render.PIXEL_VARIANCE)
        low = np.floor(grown.min(axis=0) - 3.0 * blur - 1.0).astype(np.int64)
        high = np.ceil(grown.max(axis=0) + 3.0 * blur + 2.0).astype(np.int64)
        rows, columns = image.shape
        box = np.array([max(low[1], 0), min(high[1], rows), max(low[0], 0), min(high[0], columns)])
        if box[0] >= box[1] or box[2] >= box[3]:
            return False
        maps = np.array([self._to_cells(placement) for placement in placements])
        cell = 1.0 / self.tags.family.border_cells
        side = 0.5 * (np.hypot(*(last[1] - last[0])) + np.hypot(*(last[2] - last[3]))) * cell
        other = 0.5 * (np.hypot(*(last[3] - last[0])) + np.hypot(*(last[2] - last[1]))) * cell
        render.draw_tag(
            image,
            self._rays,
            self._light,
            self._noise,
            int(self._random.integers(0, _NOISE_LENGTH)),
            box,
            maps,
            shares,
            np.array([blur / side, blur / other]),
            self._cells[tag_id],
            self.optics.black,
            self.optics.white,
            self._table,
        )
        return True

    def _to_cells(self, placement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the map from rays to cells (columns, rows downward) of one placed tag."""
        x, y, z, yaw, size = placement
        cosine, sine = np.cos(yaw), np.sin(yaw)
        cell = size / self.tags.family.border_cells
        half = 0.5 * self.tags.family.tag_cells
        # Homogeneous (column, row, 1) -> point on the tag's plane in limb_base.
        plane = np.array(
            [
                [cosine * cell, sine * cell, x - half * cell * (cosine + sine)],
                [sine * cell, -cosine * cell, y - half * cell * (sine - cosine)],
                [0.0, 0.0, z],
                [0.0, 0.0, 1.0],
            ]
        )
        pose = np.hstack([self.model.pose.rotation, self.model.pose.translation[:, None]])
        result: NDArray[np.float64] = np.linalg.inv(pose @ plane)
        return result

    def _draw_body(self, image: NDArray[np.uint8], shape: Shape) -> None:
        """Draw the limb's silhouette: dark silicone at half the height of its tags."""
        height = 0.5 * max(tag.height for tag in self.tags.limb)
        normal = np.stack([-np.sin(shape.heading), np.cos(shape.heading)], axis=1)
        left = shape.points + self.body_radius * normal
        right = shape.points - self.body_radius * normal
        outline = np.vstack([left, right[::-1]])
        points = np.column_stack([outline, np.full(len(outline), height)])
        pixels = project(self.model.intrinsics, self.model.pose, points)
        fixed = np.round(pixels * 16).astype(np.int32)
        cv2.fillPoly(image, [fixed], 52, cv2.LINE_AA, 4)

    def _make_light(self) -> NDArray[np.float32]:
        size = self.model.intrinsics
        y, x = np.mgrid[0 : size.height, 0 : size.width].astype(np.float32)
        x, y = x / size.width - 0.5, y / size.width - 0.5 * size.height / size.width
        field_ = 0.6 * x - 0.4 * y - 1.2 * (x * x + y * y)
        field_ -= field_.mean()
        light = 1.0 + self.optics.light_fall * field_
        return np.ascontiguousarray(light, dtype=np.float32)

    def _make_noise(self) -> NDArray[np.int8]:
        drawn = self._random.standard_normal(_NOISE_LENGTH, dtype=np.float32) * self.optics.noise
        return np.clip(np.round(drawn), -127, 127).astype(np.int8)

    def _draw_mounting(self) -> dict[int, NDArray[np.float64]]:
        result = {}
        for tag in self.tags.limb:
            drawn = self._random.standard_normal(3)
            scale = (self.errors.mounting, self.errors.mounting, self.errors.mounting_angle)
            result[tag.id] = np.array(tag.offset) + drawn * np.array(scale)
        return result

    def _draw_world(self) -> dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]]:
        result = {}
        for tag in self.tags.world:
            shift = self._random.standard_normal(2) * self.errors.survey
            x, y, z = tag.position
            placement = np.array([x + shift[0], y + shift[1], z, tag.yaw, tag.size])
            result[tag.id] = (self._corners(placement), placement)
        return result

    def _make_background(self) -> NDArray[np.uint8]:
        """Draw what does not move: a cloudy floor and the fixed tags, without noise."""
        size = self.model.intrinsics
        coarse = self._random.standard_normal((size.height // 40 + 2, size.width // 40 + 2))
        clouds = cv2.resize(
            coarse.astype(np.float32), (size.width, size.height), interpolation=cv2.INTER_CUBIC
        )
        floor = (self.optics.floor + 6.0 * clouds) * self._light
        image: NDArray[Any] = np.clip(np.round(floor), 0, 255).astype(np.uint8)
        noise, self._noise = self._noise, np.zeros_like(self._noise)
        for tag_id, (_, placement) in self._world.items():
            self._draw_tag(image, tag_id, placement[None], np.ones(1))
        self._noise = noise
        return image
