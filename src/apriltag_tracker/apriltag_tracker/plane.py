"""From corners in the image to poses of tags on their plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.detection import Tag
from apriltag_tracker.tag_map import UNIT_CORNERS, LimbTag


def planar_pose(
    corners: NDArray[np.float64], size: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a square of known size to four points of a plane.

    Args:
        corners: (4, 2) m, from the printed lower left counter-clockwise.
        size: edge of the square [m].

    Returns:
        x, y [m], yaw [rad], and the derivative (3, 8) of these by the corners x0 y0 x1 …
    """
    centre = corners.mean(axis=0)
    shape = UNIT_CORNERS * size
    centred = corners - centre
    # Least squares over rotations in the plane (Kabsch): the angle of one complex sum.
    cosine = float(np.sum(shape * centred))
    sine = float(np.sum(shape[:, 0] * centred[:, 1] - shape[:, 1] * centred[:, 0]))
    squared = cosine * cosine + sine * sine
    jacobian = np.zeros((3, 8))
    jacobian[0, 0::2] = 0.25
    jacobian[1, 1::2] = 0.25
    # The centroid of the shape is zero, so the mean of the corners does not enter the angle.
    jacobian[2, 0::2] = (-cosine * shape[:, 1] - sine * shape[:, 0]) / squared
    jacobian[2, 1::2] = (cosine * shape[:, 0] - sine * shape[:, 1]) / squared
    return np.array([centre[0], centre[1], np.arctan2(sine, cosine)]), jacobian


def square_misfit(corners: NDArray[np.float64], size: float) -> float:
    """Return the RMS distance of four points of a plane from a square of known size [m]."""
    pose, _ = planar_pose(corners, size)
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    placed = UNIT_CORNERS @ np.array([[cosine, sine], [-sine, cosine]]) * size + pose[:2]
    return float(np.sqrt(np.mean(np.sum((placed - corners) ** 2, axis=1))))


def locate(
    tag: Tag, height: float, size: float, intrinsics: Intrinsics, pose: CameraPose
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Place a tag that lies flat at a known height.

    Returns:
        x, y [m], yaw [rad]; their (3, 3) covariance from the noise of the corners; and the misfit of
        the corners to a square of the tag's size [m].
    """
    rays = intrinsics.rays(tag.corners)
    on_plane = pose.onto_plane(rays, height)
    place, by_corners = planar_pose(on_plane, size)
    # Pixels to rays: the lens bends little across a tag, so the focal length is the slope.
    by_rays = pose.plane_jacobian(rays, height)
    slopes = np.zeros((8, 8))
    scale = np.diag(1.0 / np.diag(intrinsics.matrix)[:2])
    for k in range(4):
        slopes[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = by_rays[k] @ scale
    gain = by_corners @ slopes
    return place, gain @ tag.covariance @ gain.T, square_misfit(on_plane, size)


def centreline_pose(place: NDArray[np.float64], tag: LimbTag) -> NDArray[np.float64]:
    """Take the mounting offset off a tag's pose: the centreline's pose at its arc length, (3,)."""
    along, across, turn = tag.offset
    heading = place[2] - turn
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.array(
        [
            place[0] - cosine * along + sine * across,
            place[1] - sine * along - cosine * across,
            heading,
        ]
    )


def height_slope(
    place: NDArray[np.float64], height: float, pose: CameraPose
) -> NDArray[np.float64]:
    """Return how a tag's pose moves with an error of its height, (3,) m/m: radially from the camera."""
    origin = pose.position
    shift = (place[:2] - origin[:2]) / (height - origin[2])
    return np.array([shift[0], shift[1], 0.0])
