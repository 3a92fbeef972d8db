"""From corners in the image to poses of tags on their plane, with the noise carried along."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.tag_map import UNIT_CORNERS


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
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Place tags that lie flat at known heights.

    Args:
        corners: (n, 4, 2) px.
        covariances: (n, 8, 8) px² of the corners.
        heights: (n,) m above the base plane.
        sizes: (n,) m, edges of the black borders.
        intrinsics: of the camera.
        pose: of the camera.

    Returns:
        Poses (n, 3) x, y [m], yaw [rad]; their (n, 3, 3) covariance from the noise of the corners;
        and the RMS misfit (n,) of the corners to a square of the tag's size [m].
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
    gain = np.einsum("npkr,nkra->npka", slopes.reshape(-1, 3, 4, 2), changes).reshape(-1, 3, 8)
    return places, gain @ covariances @ gain.transpose(0, 2, 1), misfits


def pose_moves(
    places: NDArray[np.float64],
    heights: NDArray[np.float64],
    sizes: NDArray[np.float64],
    pose: CameraPose,
) -> NDArray[np.float64]:
    """Return how placed tags move with the camera's pose while their pixels stay.

    A point X of the camera's frame that turns by ω and shifts by τ goes to X + ω × X + τ; what the
    pixel shows on the plane moves so that the ray stays.

    Args:
        places: (n, 3) x, y [m], yaw [rad].
        heights: (n,) m.
        sizes: (n,) m.
        pose: of the camera.

    Returns:
        (n, 3, 6) derivatives of x, y, yaw by ω [rad] and τ [m].
    """
    half = 0.5 * sizes
    cosine, sine = half * np.cos(places[:, 2]), half * np.sin(places[:, 2])
    centres, zero = np.column_stack([places[:, :2], heights]), np.zeros(len(places))
    along, over = np.stack([cosine, sine, zero], axis=1), np.stack([-sine, cosine, zero], axis=1)
    points = np.stack([centres, centres + along, centres + over])
    seen = points @ pose.rotation.T + pose.translation
    shifts = np.empty((*seen.shape[:2], 6, 3))
    shifts[:, :, :3] = np.cross(np.eye(3), seen[:, :, None])
    shifts[:, :, 3:] = np.eye(3)
    rays, turned = seen @ pose.rotation, shifts @ pose.rotation
    moves = rays[:, :, None, :2] / rays[:, :, None, 2:] * turned[..., 2:] - turned[..., :2]
    middle, right, up = moves.transpose(0, 1, 3, 2)
    turn = np.einsum("nr,nrk->nk", over[:, :2], right - middle)
    turn -= np.einsum("nr,nrk->nk", along[:, :2], up - middle)
    return np.concatenate([middle, 0.5 * (turn / half[:, None] ** 2)[:, None]], axis=1)
