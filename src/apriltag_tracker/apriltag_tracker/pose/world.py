"""The camera's pose from the fixed tags, and what it makes of corners: places on the tags' planes.

The pose is averaged while nothing moves and watched for bumps; the noise is carried along.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraError, CameraPose, Intrinsics, solve_pose
from apriltag_tracker.detection import Tag
from apriltag_tracker.tag_map import UNIT_CORNERS, TagMap

_MEMORY = 150
"""Pictures over which corners are averaged."""
_SOLVE_EVERY = 30
"""Frames between two solutions once the pose has settled."""
_BUMP = 0.5
"""Shift of the fixed tags, all together, that means that the camera was moved [px]."""
_BUMP_FRAMES = 3
"""Frames in a row that must show it."""
_MOVING = 2.0
"""Shift from which on a picture is of no use until the pose is found again [px]."""
_MISFIT = 1.5
"""Residual at which a fixed tag does not fit the others [px]."""


@dataclass
class _Seen:
    """Mean of one fixed tag's corners over the pictures in which it was found.

    Attributes:
        corners: (4, 2) px.
        noise: (8, 8) px², covariance of the mean that the pictures' noise leaves.
        count: of pictures; older ones fade once it stays.
    """

    corners: NDArray[np.float64] = field(default_factory=lambda: np.zeros((4, 2)))
    noise: NDArray[np.float64] = field(default_factory=lambda: np.zeros((8, 8)))
    count: int = 0

    def add(self, tag: Tag) -> None:
        """Take one more picture."""
        self.count = min(self.count + 1, _MEMORY)
        share = 1.0 / self.count
        self.corners += share * (tag.corners - self.corners)
        self.noise = (1.0 - share) ** 2 * self.noise + share**2 * tag.covariance


LASTING_ERROR = 0.012
"""A corner has this error in every picture alike, so that averaging does not remove it [px].

A lens bends the sides of a tag, and pixels are rounded to whole grey levels.
"""


class WorldPose:
    """Keeps the camera pose.

    Args:
        tags: the tag map.
        intrinsics: of the camera.
    """

    def __init__(self, tags: TagMap, intrinsics: Intrinsics) -> None:
        self._places = {tag.id: tag.corners() for tag in tags.world}
        self._intrinsics = intrinsics
        self._seen: defaultdict[int, _Seen] = defaultdict(_Seen)
        self._frames = 0
        self._shift, self._shifted = 0.0, 0
        self.pose: CameraPose | None = None
        self.covariance = np.zeros((6, 6))
        """Of the pose: a rotation vector [rad] and a shift [m], both in the camera's frame."""
        self.residual = float("nan")
        """RMS reprojection error of the fixed tags in the present solution [px]."""
        self.bumps = 0
        self.excluded: dict[int, float] = {}
        """Fixed tags that do not fit the others, with their residual [px]."""
        self.problem = (
            f"no fixed tag ({', '.join(map(str, self._places))}) has been seen yet: aim and focus "
            "the camera, compare ids and family with the tag map; a mirrored picture shows none"
        )

    def update(self, tags: Sequence[Tag]) -> CameraPose | None:
        """Take the fixed tags of one image and return the pose to use for it, None without one."""
        known = [tag for tag in tags if tag.id in self._places]
        if self._moved(known):
            self.bumps += 1
            self._seen.clear()
            self._frames = self._shifted = 0
            self._shift = 0.0
        if known and self._shift > _MOVING:
            self.problem = "the camera or the table is moving, or was just moved"
            return None
        for tag in known:
            self._seen[tag.id].add(tag)
        if known and (self._frames < 10 or self._frames % _SOLVE_EVERY == 0):
            self._solve()
        if known:
            self._frames += 1
        return self.pose

    def _moved(self, known: Sequence[Tag]) -> bool:
        """Tell whether most fixed tags have been elsewhere than their mean for a few frames."""
        averaged = [tag for tag in known if tag.id in self._seen]
        if not averaged:
            self._shift, self._shifted = 0.0, 0
            return False
        gaps = np.array([tag.corners - self._seen[tag.id].corners for tag in averaged])
        shifts = sorted(np.hypot(*gaps.mean(axis=1).T).tolist())
        self._shift = shifts[(len(shifts) - 1) // 2]
        self._shifted = self._shifted + 1 if self._shift > _BUMP else 0
        return self._shifted >= _BUMP_FRAMES

    def _solve(self) -> None:
        ids = sorted(self._seen)
        excluded: dict[int, float] = {}
        start = self.pose if self._frames > 0 else None
        while ids:
            try:
                pose, residuals = self._fit(ids, start)
            except CameraError as error:
                self.pose, self.problem = None, str(error)
                return
            per_tag = np.sqrt(np.mean(np.sum(residuals.reshape(-1, 4, 2) ** 2, axis=2), axis=1))
            worst = int(np.argmax(per_tag))
            if per_tag[worst] <= _MISFIT or len(ids) <= 2:
                break
            # Out goes the tag without which the others agree best, not the one that shows it most.
            worst = self._best_without(ids)
            excluded[ids[worst]] = float(per_tag[worst])
            del ids[worst]
            start = None
        if per_tag.max() > 4.0 * _MISFIT or len(ids) < len(excluded):
            self.pose = None
            self.problem = (
                f"only {len(ids)} of {len(self._seen)} fixed tags fit together, {ids}, to "
                f"{per_tag.max():.1f} px: survey positions, sizes and yaw again (OpenCV draws tags "
                "turned by π) or calibrate the camera"
            )
            return
        self.pose, self.excluded, self.problem = pose, excluded, ""
        self.residual = float(np.sqrt(np.mean(residuals**2)))
        self.covariance = self._pose_covariance(pose, ids)

    def _fit(
        self, ids: Sequence[int], start: CameraPose | None = None
    ) -> tuple[CameraPose, NDArray[np.float64]]:
        """Solve the pose from some of the fixed tags; return as `solve_pose`, or raise the same."""
        points = np.vstack([self._places[tag] for tag in ids])
        pixels = np.vstack([self._seen[tag].corners for tag in ids])
        return solve_pose(self._intrinsics, points, pixels, start)

    def _pose_covariance(self, pose: CameraPose, ids: Sequence[int]) -> NDArray[np.float64]:
        """Carry the noise of the averaged corners over to the pose that fits them best, (6, 6)."""
        seen = np.vstack([self._places[tag] for tag in ids]) @ pose.rotation.T + pose.translation
        lens, still = self._intrinsics, np.zeros(3)
        _, slopes = cv2.projectPoints(seen, still, still, lens.matrix, lens.distortion)
        # Of a point in the camera's frame, the first six are by a turn and a shift there.
        parts = np.linalg.pinv(slopes[:, :6]).reshape(6, -1, 8).swapaxes(0, 1)
        spreads = np.array([self._seen[tag].noise for tag in ids]) + LASTING_ERROR**2 * np.eye(8)
        return np.asarray((parts @ spreads @ parts.swapaxes(1, 2)).sum(axis=0))

    def _best_without(self, ids: Sequence[int]) -> int:
        """Return the place among some fixed tags of the one without which the others agree best."""
        costs = []
        for left_out in range(len(ids)):
            try:
                _, residuals = self._fit([*ids[:left_out], *ids[left_out + 1 :]])
                costs.append(float(np.mean(residuals**2)))
            except CameraError:
                costs.append(np.inf)
        return int(np.argmin(costs))


def planar_poses(
    corners: NDArray[np.float64], sizes: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Fit squares of known sizes to four points of a plane each (Kabsch 1976, in the plane).

    Args:
        corners: (n, 4, 2) m, from the printed lower left counter-clockwise.
        sizes: (n,) m, edges of the squares.

    Returns:
        x, y [m] and yaw [rad], (n, 3); their derivatives (n, 3, 8) by the corners x0 y0 x1 …; and
        the RMS distance (n,) of the corners from the square [m].
    """
    centres = corners.mean(axis=1)
    off = corners - centres[:, None]
    u, v = np.moveaxis(sizes[:, None, None] * UNIT_CORNERS, 2, 0)
    cosine = np.sum(u * off[:, :, 0] + v * off[:, :, 1], axis=1)[:, None]
    sine = np.sum(u * off[:, :, 1] - v * off[:, :, 0], axis=1)[:, None]
    norm = np.hypot(cosine, sine)
    turned = np.stack([cosine * u - sine * v, sine * u + cosine * v], axis=2) / norm[:, :, None]
    misfits = np.sqrt(np.mean(np.sum((off - turned) ** 2, axis=2), axis=1))
    slopes = np.zeros((len(corners), 3, 8))
    slopes[:, 0, 0::2] = slopes[:, 1, 1::2] = 0.25
    # The square's own centre is zero, so the mean of the corners does not enter the angle.
    slopes[:, 2, 0::2] = (-cosine * v - sine * u) / norm**2
    slopes[:, 2, 1::2] = (cosine * u - sine * v) / norm**2
    return np.column_stack([centres, np.arctan2(sine, cosine)]), slopes, misfits


def locate(
    corners: NDArray[np.float64],
    covariances: NDArray[np.float64],
    heights: NDArray[np.float64],
    sizes: NDArray[np.float64],
    intrinsics: Intrinsics,
    pose: CameraPose,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Place tags that lie flat at known heights.

    A point X of the camera's frame that turns by ω and shifts by τ goes to X + ω × X + τ; what the
    pixel shows on the plane moves so that the ray stays.

    Args:
        corners: (n, 4, 2) px.
        covariances: (n, 8, 8) px² of the corners.
        heights: (n,) m above the base plane.
        sizes: (n,) m, edges of the black borders.
        intrinsics: of the camera.
        pose: of the camera.

    Returns:
        Places (n, 3): x, y [m], yaw [rad]; their covariances (n, 3, 3) from the noise of the
        corners; the RMS distance (n,) of the corners from a square of the tag's size [m]; and the
        derivatives (n, 3, 6) of the places, while the pixels stay, by a turn [rad] and a shift [m]
        of the camera's frame.
    """
    rotation, origin = pose.rotation, pose.position
    rays = intrinsics.rays(corners.reshape(-1, 2)).reshape(-1, 4, 2)
    directions = rays @ rotation[:2] + rotation[2]
    across, down = directions[:, :, :2], directions[:, :, 2:]
    gap = (heights - origin[2])[:, None, None]
    places, slopes, misfits = planar_poses(origin[:2] + gap * across / down, sizes)
    # The lens bends little across a tag: the focal length is the slope of the rays.
    focal = np.diag(intrinsics.matrix)[:2]
    changes = rotation[:2, :2].T * down[:, :, :, None] - across[:, :, :, None] * rotation[:2, 2]
    changes *= gap[:, :, :, None] / down[:, :, :, None] ** 2 / focal
    by_corner = slopes.reshape(-1, 3, 4, 2)
    gain = np.einsum("npkr,nkra->npka", by_corner, changes).reshape(-1, 3, 8)
    seen = np.concatenate([rays, np.ones_like(down)], axis=2) * gap / down
    shifts = np.empty((*seen.shape[:2], 6, 3))
    shifts[:, :, :3] = np.cross(np.eye(3), seen[:, :, None])
    shifts[:, :, 3:] = np.eye(3)
    turned = shifts @ rotation
    moves = (across / down)[:, :, None] * turned[..., 2:] - turned[..., :2]
    moves = np.einsum("npkr,nkmr->npm", by_corner, moves)
    return places, gain @ covariances @ gain.transpose(0, 2, 1), misfits, moves
