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

FINE = 6
"""Parts of a pixel along each side."""

_FLOOR, _BLACK, _WHITE = 0.55, 0.13, 1.0
_FULL = 205.0


@dataclass(frozen=True)
class Scene:
    """How the pictures of one row of the table are made.

    Attributes:
        name: of the row.
        pixels: side of the tags' border [px].
        blur: standard deviation of the lens [px].
        defocus: radius of the disc that a point becomes [px].
        noise: standard deviation of reading [grey levels]; photons add the root of 2 % of a level.
        contrast: brightness of the light as a share of the full.
        smear: way of every tag during the exposure [px], each in another direction.
        turn: of every tag during the exposure [rad].
        rolling: way of every tag from the first to the last row of its picture [px].
        corner: share of both sides at one corner that is covered.
        side: share of one side that is covered.
        cover: brightness of what covers it; the sheet has 1, its surroundings 0.55.
        family: of the tags.
    """

    name: str
    pixels: float = 30.0
    blur: float = 0.6
    defocus: float = 0.0
    noise: float = 2.0
    contrast: float = 1.0
    smear: float = 0.0
    turn: float = 0.0
    rolling: float = 0.0
    corner: float = 0.0
    side: float = 0.0
    cover: float = 0.34
    family: Family = TAG36H11


def render(
    scene: Scene, seed: int, size: tuple[int, int] = (640, 480)
) -> tuple[NDArray[np.uint8], dict[int, NDArray[np.float64]]]:
    """Render a grid of tags in all directions, tilted by up to 25 degrees.

    Returns:
        The picture, and the true corners (4, 2) px by id at mid-exposure; with a rolling shutter
        each of them when its own row is exposed.
    """
    random = np.random.default_rng((seed, 71))
    width, height = size
    picture = np.full((height, width), _FLOOR)
    truth = {}
    room = 1.3 * scene.pixels + 0.5 * (scene.smear + scene.rolling) + 3.0 * scene.blur
    # The sheet of a family of few cells is wider against its border.
    sheet = max(1.0, scene.family.tag_cells / scene.family.border_cells / 1.25)
    half = int(np.ceil(0.5 * 1.45 * sheet * scene.pixels + scene.smear + scene.rolling + 4.0))
    pitch = max(2 * half + 2, int(room))
    for top in range(0, height - pitch + 1, pitch):
        for left in range(0, width - pitch + 1, pitch):
            tag = int(random.integers(0, scene.family.tag_count))
            if tag in truth:
                continue
            middle = np.array([left, top]) + 0.5 * pitch + random.uniform(-0.5, 0.5, 2)
            corners = _placed(scene.pixels, middle, random)
            patch, way = _patch(scene, tag, corners, (left, top, pitch), random)
            picture[top : top + pitch, left : left + pitch] = patch
            truth[tag] = _as_rolled(corners, way, scene)
    y, x = np.mgrid[0:height, 0:width]
    light = 1.0 + 0.2 * ((x / width - 0.5) - 0.6 * (y / height - 0.5))
    level = picture * light * scene.contrast * _FULL
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


def _patch(
    scene: Scene,
    tag: int,
    corners: NDArray[np.float64],
    box: tuple[int, int, int],
    random: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the picture (pitch, pitch) of one tag, 1 is white, and the direction it goes."""
    left, top, pitch = box
    rim = scene.family.rim
    across = scene.family.tag_cells + 2
    cells = np.full((across, across), _FLOOR)
    cells[1:-1, 1:-1] = np.where(scene.family.printed_cells(tag) > 0, _WHITE, _BLACK)
    # Corners of the border in cells, columns to the right and rows down.
    start, end = rim + 1.0, across - rim - 1.0
    target = np.array([[start, end], [end, end], [end, start], [start, start]], dtype=np.float32)
    to_cells = cv2.getPerspectiveTransform(corners.astype(np.float32), target).astype(np.float64)
    # float32 corners lose some 1e-5 px; what is rendered is what the truth says to 1e-3 px.
    fine = (np.arange(pitch * FINE) + 0.5) / FINE - 0.5
    x, y = np.meshgrid(fine + left, fine + top)
    way = random.uniform(-np.pi, np.pi)
    direction = np.array([np.cos(way), np.sin(way)])
    middle = corners.mean(axis=0)
    moving = scene.smear > 0.0 or scene.turn != 0.0
    instants = max(int(4.0 * scene.smear) | 1, 15) if moving else 1
    late = (y - middle[1]) / scene.pixels
    total = np.zeros_like(x)
    for k in range(instants):
        t = (k + 0.5) / instants - 0.5
        dx = x - middle[0] - direction[0] * (scene.smear * t + scene.rolling * late)
        dy = y - middle[1] - direction[1] * (scene.smear * t + scene.rolling * late)
        cosine, sine = np.cos(scene.turn * t), np.sin(scene.turn * t)
        px, py = cosine * dx + sine * dy + middle[0], -sine * dx + cosine * dy + middle[1]
        w = to_cells[2, 0] * px + to_cells[2, 1] * py + to_cells[2, 2]
        column = (to_cells[0, 0] * px + to_cells[0, 1] * py + to_cells[0, 2]) / w
        row = (to_cells[1, 0] * px + to_cells[1, 1] * py + to_cells[1, 2]) / w
        i = np.clip(np.floor(row).astype(np.int64), 0, across - 1)
        j = np.clip(np.floor(column).astype(np.int64), 0, across - 1)
        total += cells[i, j]
    total /= instants
    _cover(total, scene, corners - (left, top))
    total = _lens(total, scene)
    return total.reshape(pitch, FINE, pitch, FINE).mean(axis=(1, 3)), direction


def _as_rolled(
    corners: NDArray[np.float64], direction: NDArray[np.float64], scene: Scene
) -> NDArray[np.float64]:
    """Return where corners appear when each row is exposed later than the one before.

    A point at p appears at q with q = p + d a (q_y - m), m the middle's row, d the direction.
    """
    share = scene.rolling / scene.pixels
    middle = corners.mean(axis=0)
    late = (corners[:, 1] - middle[1]) / (1.0 - direction[1] * share)
    return np.asarray(corners + share * late[:, None] * direction)


def _cover(total: NDArray[np.float64], scene: Scene, corners: NDArray[np.float64]) -> None:
    """Lay something over a corner or the middle of a side."""
    a, b, _, d = corners
    polygon = None
    if scene.corner > 0.0:
        out = (a - b) + (a - d)
        along, across = scene.corner * (b - a), scene.corner * (d - a)
        polygon = [
            a + along,
            a + across,
            a + across + 0.4 * out,
            a + 0.6 * out,
            a + along + 0.4 * out,
        ]
    elif scene.side > 0.0:
        out = 0.35 * (a - d)
        start, end = a + 0.4 * (b - a), a + (0.4 + scene.side) * (b - a)
        polygon = [start + out, end + out, end - 0.25 * out, start - 0.25 * out]
    if polygon is not None:
        points = np.round((np.array(polygon) + 0.5) * FINE - 0.5).astype(np.int32)
        cv2.fillPoly(total, [points], scene.cover)


def _lens(total: NDArray[np.float64], scene: Scene) -> NDArray[np.float64]:
    if scene.defocus > 0.0:
        reach = int(np.ceil(scene.defocus * FINE))
        y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
        disc = (x * x + y * y <= (scene.defocus * FINE) ** 2).astype(np.float64)
        total = cv2.filter2D(total, -1, disc / disc.sum(), borderType=cv2.BORDER_REPLICATE)
    sigma = scene.blur * FINE
    return np.asarray(cv2.GaussianBlur(total, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
