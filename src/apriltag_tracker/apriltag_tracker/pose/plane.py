"""From corners in the image to poses of tags on their plane, with the noise carried along."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from apriltag_tracker.camera import CameraPose, Intrinsics
from apriltag_tracker.camera.lens import undistort_pixels
from apriltag_tracker.tag_map import LimbTag


@njit(cache=True)
def planar_pose(
    corners: NDArray[np.float64], size: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Fit a square of known size to four points of a plane (Kabsch 1976, in the plane).

    Args:
        corners: (4, 2) m, from the printed lower left counter-clockwise.
        size: edge of the square [m].

    Returns:
        x, y [m] and yaw [rad]; the derivative (3, 8) of these by the corners x0 y0 x1 …; and the
        RMS distance of the corners from the square [m].
    """
    x = (corners[0, 0] + corners[1, 0] + corners[2, 0] + corners[3, 0]) / 4.0
    y = (corners[0, 1] + corners[1, 1] + corners[2, 1] + corners[3, 1]) / 4.0
    half = 0.5 * size
    cosine, sine = 0.0, 0.0
    for k in range(4):
        u = half if k in {1, 2} else -half
        v = half if k in {2, 3} else -half
        cosine += u * (corners[k, 0] - x) + v * (corners[k, 1] - y)
        sine += u * (corners[k, 1] - y) - v * (corners[k, 0] - x)
    squared = cosine * cosine + sine * sine
    norm = math.sqrt(squared)
    jacobian = np.zeros((3, 8))
    misfit = 0.0
    for k in range(4):
        u = half if k in {1, 2} else -half
        v = half if k in {2, 3} else -half
        jacobian[0, 2 * k] = 0.25
        jacobian[1, 2 * k + 1] = 0.25
        # The square's own centre is zero, so the mean of the corners does not enter the angle.
        jacobian[2, 2 * k] = (-cosine * v - sine * u) / squared
        jacobian[2, 2 * k + 1] = (cosine * u - sine * v) / squared
        gap_x = corners[k, 0] - x - (cosine * u - sine * v) / norm
        gap_y = corners[k, 1] - y - (sine * u + cosine * v) / norm
        misfit += gap_x * gap_x + gap_y * gap_y
    return np.array([x, y, math.atan2(sine, cosine)]), jacobian, math.sqrt(misfit / 4.0)


@njit(cache=True)
def _locate(
    corners: NDArray[np.float64],
    covariances: NDArray[np.float64],
    heights: NDArray[np.float64],
    sizes: NDArray[np.float64],
    matrix: NDArray[np.float64],
    distortion: NDArray[np.float64],
    rotation: NDArray[np.float64],
    origin: NDArray[np.float64],
    places: NDArray[np.float64],
    spreads: NDArray[np.float64],
    misfits: NDArray[np.float64],
) -> None:
    on_plane = np.empty((4, 2))
    for i in range(corners.shape[0]):
        rays = undistort_pixels(corners[i], matrix, distortion)
        slopes = np.zeros((8, 8))
        gap = heights[i] - origin[2]
        for k in range(4):
            direction = rays[k, 0] * rotation[0] + rays[k, 1] * rotation[1] + rotation[2]
            for row in range(2):
                on_plane[k, row] = origin[row] + gap * direction[row] / direction[2]
                for axis in range(2):
                    # The lens bends little across a tag: the focal length is the slope of the rays.
                    change = rotation[axis, row] * direction[2]
                    change -= direction[row] * rotation[axis, 2]
                    slopes[2 * k + row, 2 * k + axis] = (
                        gap * change / direction[2] ** 2 / matrix[axis, axis]
                    )
        place, by_corners, misfit = planar_pose(on_plane, sizes[i])
        gain = by_corners @ slopes
        places[i] = place
        spreads[i] = gain @ covariances[i] @ gain.T
        misfits[i] = misfit


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
    count = len(corners)
    places, spreads = np.empty((count, 3)), np.empty((count, 3, 3))
    misfits = np.empty(count)
    _locate(
        np.ascontiguousarray(corners),
        np.ascontiguousarray(covariances),
        np.ascontiguousarray(heights),
        np.ascontiguousarray(sizes),
        intrinsics.matrix,
        intrinsics.distortion,
        np.ascontiguousarray(pose.rotation),
        pose.position,
        places,
        spreads,
        misfits,
    )
    return places, spreads, misfits


@njit(cache=True)
def _moves_of_a_point(
    point: NDArray[np.float64],
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    moves: NDArray[np.float64],
) -> None:
    """Write how x and y of a point on its plane move with the camera's pose, (2, 6)."""
    seen = rotation @ point + translation
    down = np.ascontiguousarray(rotation.T)
    ray = down @ seen
    shift = np.zeros(3)
    for k in range(6):
        shift[:] = 0.0
        if k < 3:
            # e × X of the axis k.
            after, last = (k + 1) % 3, (k + 2) % 3
            shift[after], shift[last] = -seen[last], seen[after]
        else:
            shift[k - 3] = 1.0
        turned = down @ shift
        for row in range(2):
            moves[row, k] = ray[row] * turned[2] / ray[2] - turned[row]


@njit(cache=True)
def _pose_moves(
    places: NDArray[np.float64],
    heights: NDArray[np.float64],
    sizes: NDArray[np.float64],
    rotation: NDArray[np.float64],
    translation: NDArray[np.float64],
    result: NDArray[np.float64],
) -> None:
    right, up = np.empty((2, 6)), np.empty((2, 6))
    for i in range(places.shape[0]):
        centre = np.array([places[i, 0], places[i, 1], heights[i]])
        half = 0.5 * sizes[i]
        cosine, sine = half * math.cos(places[i, 2]), half * math.sin(places[i, 2])
        middle = result[i, :2]
        along, across = np.array([cosine, sine, 0.0]), np.array([-sine, cosine, 0.0])
        _moves_of_a_point(centre, rotation, translation, middle)
        _moves_of_a_point(centre + along, rotation, translation, right)
        _moves_of_a_point(centre + across, rotation, translation, up)
        for k in range(6):
            turn = -sine * (right[0, k] - middle[0, k]) + cosine * (right[1, k] - middle[1, k])
            turn -= cosine * (up[0, k] - middle[0, k]) + sine * (up[1, k] - middle[1, k])
            result[i, 2, k] = 0.5 * turn / half**2


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
    result = np.empty((len(places), 3, 6))
    _pose_moves(
        np.ascontiguousarray(places),
        np.ascontiguousarray(heights),
        np.ascontiguousarray(sizes),
        np.ascontiguousarray(pose.rotation),
        np.ascontiguousarray(pose.translation),
        result,
    )
    return result


def centreline_pose(place: NDArray[np.float64], tag: LimbTag) -> NDArray[np.float64]:
    """Take the mounting offset off a tag's pose: the centreline's pose at its arc length, (3,)."""
    along, across, turn = tag.offset
    heading = place[2] - turn
    cosine, sine = math.cos(heading), math.sin(heading)
    return np.array(
        [
            place[0] - cosine * along + sine * across,
            place[1] - sine * along - cosine * across,
            heading,
        ]
    )
