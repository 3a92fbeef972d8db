"""Pictures of tags by brute force, independent of what the tracker assumes of a camera.

Every pixel is cut into 6 x 6 parts and the exposure into instants; the colour of the printed cell
that each part sees at each instant is averaged. The lens is a Gaussian or a disc (defocus) on the
fine grid, the noise is that of photons and of reading. Nothing here is shared with the detector or
with the closed form of the synthetic camera but the printed codes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.family import TAG36H11, Family

FLOOR, BLACK, WHITE = 0.55, 0.13, 1.0
"""Brightness of the floor, of printed black and of paper."""

FULL = 205.0
"""White paper in full light has this grey level."""

_FINE = 6
"""A pixel has so many parts along each side."""


@dataclass(frozen=True)
class Scene:
    """How pictures of tags are made.

    Attributes:
        name: of the row in a table.
        pixels: side of the tags' border [px].
        blur: standard deviation of the lens [px].
        defocus: radius of the disc that a point becomes [px].
        noise: standard deviation of reading [grey levels]; photons add the root of 2 % of a level.
        contrast: brightness of the light as a share of the full.
        smear: way of every tag during the exposure [px], each in another direction.
        corner: share of both sides at one corner that something dark covers.
        family: of the tags.
    """

    name: str
    pixels: float = 30.0
    blur: float = 0.6
    defocus: float = 0.0
    noise: float = 2.0
    contrast: float = 1.0
    smear: float = 0.0
    corner: float = 0.0
    family: Family = TAG36H11


def render(
    scene: Scene, seed: int, size: tuple[int, int] = (640, 480)
) -> tuple[NDArray[np.uint8], dict[int, NDArray[np.float64]]]:
    """Render a grid of tags in all directions, tilted by up to 25 degrees.

    Returns:
        The picture (rows, columns), and the true corners (4, 2) px by id at mid-exposure.
    """
    random = np.random.default_rng((seed, 71))
    width, height = size
    picture = np.full((height, width), FLOOR)
    truth = {}
    # The sheet of a family of few cells is wider against its border.
    sheet = max(1.0, scene.family.tag_cells / scene.family.border_cells / 1.25)
    pitch = 2 * int(np.ceil(0.5 * 1.45 * sheet * scene.pixels + scene.smear + 4.0)) + 2
    for top in range(0, height - pitch + 1, pitch):
        for left in range(0, width - pitch + 1, pitch):
            tag = int(random.integers(0, scene.family.tag_count))
            if tag in truth:
                continue
            middle = np.array([left, top]) + 0.5 * pitch + random.uniform(-0.5, 0.5, 2)
            truth[tag] = _placed(scene.pixels, middle, random)
            way = random.uniform(-np.pi, np.pi)
            patch = draw_patch(scene, tag, truth[tag] - (left, top), pitch, way)
            picture[top : top + pitch, left : left + pitch] = patch
    y, x = np.mgrid[0:height, 0:width]
    light = 1.0 + 0.2 * ((x / width - 0.5) - 0.6 * (y / height - 0.5))
    level = picture * light * scene.contrast * FULL
    level = level + random.normal(0.0, 1.0, level.shape) * np.sqrt(scene.noise**2 + 0.02 * level)
    return np.clip(np.round(level), 0, 255).astype(np.uint8), truth


def _placed(
    pixels: float, middle: NDArray[np.float64], random: np.random.Generator
) -> NDArray[np.float64]:
    """Return the corners of a tag that is turned and tilted, seen from 20 times its size."""
    yaw, about = random.uniform(-np.pi, np.pi, 2)
    tilt = random.uniform(0.0, np.radians(25.0))
    square = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    turned = cv2.Rodrigues(np.array([0.0, 0.0, yaw]))[0]
    axis = tilt * np.array([np.cos(about), np.sin(about), 0.0])
    points = square @ turned.T @ cv2.Rodrigues(axis)[0].T
    seen = points[:, :2] * (20.0 / (20.0 + points[:, 2:])) * pixels
    # The image's y axis points down.
    return np.asarray(seen * (1.0, -1.0) + middle)


def draw_patch(
    scene: Scene, tag: int, corners: NDArray[np.float64], size: int, way: float = 0.0
) -> NDArray[np.float64]:
    """Return the brightness (size, size) of a picture of one tag.

    Args:
        scene: what the picture is like.
        tag: id within the family.
        corners: (4, 2) px, from the printed lower left counter-clockwise.
        size: of the picture [px].
        way: direction in which the tag goes during the exposure [rad].
    """
    rim, across = scene.family.rim, scene.family.tag_cells + 2
    cells = np.full((across, across), FLOOR)
    cells[1:-1, 1:-1] = np.where(scene.family.printed_cells(tag) > 0, WHITE, BLACK)
    # Corners of the border in cells, columns to the right and rows down.
    start, end = rim + 1.0, across - rim - 1.0
    target = np.array([[start, end], [end, end], [end, start], [start, start]], dtype=np.float32)
    # float32 corners lose some 1e-5 px; what is rendered is what the truth says to 1e-3 px.
    to_cells = cv2.getPerspectiveTransform(corners.astype(np.float32), target).astype(np.float64)
    fine = (np.arange(size * _FINE) + 0.5) / _FINE - 0.5
    x, y = np.meshgrid(fine, fine)
    instants = max(int(4.0 * scene.smear) | 1, 15) if scene.smear else 1
    total = np.zeros_like(x)
    for k in range(instants):
        gone = scene.smear * ((k + 0.5) / instants - 0.5)
        points = np.stack([x - gone * np.cos(way), y - gone * np.sin(way), np.ones_like(x)])
        column, row, scale = np.tensordot(to_cells, points, 1)
        i = np.clip(np.floor(row / scale).astype(np.int64), 0, across - 1)
        j = np.clip(np.floor(column / scale).astype(np.int64), 0, across - 1)
        total += cells[i, j] / instants
    _cover(total, scene, corners)
    total = _lens(total, scene)
    return np.asarray(total.reshape(size, _FINE, size, _FINE).mean(axis=(1, 3)))


def _cover(total: NDArray[np.float64], scene: Scene, corners: NDArray[np.float64]) -> None:
    """Lay something dark over a corner."""
    if scene.corner == 0.0:
        return
    a, b, _, d = corners
    out = (a - b) + (a - d)
    on_side, on_other = a + scene.corner * (b - a), a + scene.corner * (d - a)
    polygon = [on_side, on_other, on_other + 0.4 * out, a + 0.6 * out, on_side + 0.4 * out]
    points = np.round((np.array(polygon) + 0.5) * _FINE - 0.5).astype(np.int32)
    cv2.fillPoly(total, [points], 0.34)


def _lens(total: NDArray[np.float64], scene: Scene) -> NDArray[np.float64]:
    """Blur a fine picture by the disc and the Gaussian of the lens."""
    if scene.defocus > 0.0:
        reach = int(np.ceil(scene.defocus * _FINE))
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        disc = (x * x + y * y <= (scene.defocus * _FINE) ** 2).astype(np.float64)
        total = cv2.filter2D(total, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    sigma = scene.blur * _FINE
    return np.asarray(cv2.GaussianBlur(total, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
