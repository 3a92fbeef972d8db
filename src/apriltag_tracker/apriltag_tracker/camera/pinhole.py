"""The camera: lens and calibration, pose from fixed tags, and rays onto planes above the base.

The lens distorts as Brown and Conrady say, with the rational terms; coefficients are ordered as
OpenCV and `sensor_msgs/CameraInfo` order them. Normalised coordinates are x/z, y/z in the camera's
optical frame. Pixels have the centre of the first pixel at (0, 0). A camera pose maps points of
`limb_base` into the camera's optical frame (x right, y down, z forward).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numba import njit
from numpy.typing import NDArray

PINHOLE_MODELS = ("plumb_bob", "rational_polynomial")

COEFFICIENTS = 8
"""A lens has so many coefficients of distortion: k1 k2 p1 p2 k3 k4 k5 k6."""
UNDISTORTED = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-10)
"""A ray is found once it meets its pixel to 1e-10 px, or after a hundred steps, which are enough
but for the rim of a wide lens, where its calibration folds."""


class CameraError(ValueError):
    """A calibration or a pose cannot be used; the message names what and the remedy."""


@njit(cache=True)
def distort(x: float, y: float, d: NDArray[np.float64]) -> tuple[float, float]:
    """Return where the lens puts a normalised point."""
    r2 = x * x + y * y
    radial = (1.0 + r2 * (d[0] + r2 * (d[1] + r2 * d[4]))) / (
        1.0 + r2 * (d[5] + r2 * (d[6] + r2 * d[7]))
    )
    xd = x * radial + 2.0 * d[2] * x * y + d[3] * (r2 + 2.0 * x * x)
    yd = y * radial + d[2] * (r2 + 2.0 * y * y) + 2.0 * d[3] * x * y
    return xd, yd


@dataclass(frozen=True)
class Intrinsics:
    """Calibration of a camera.

    Attributes:
        width: of the image [px].
        height: of the image [px].
        matrix: (3, 3) camera matrix [px].
        distortion: (8,) k1 k2 p1 p2 k3 k4 k5 k6.
    """

    width: int
    height: int
    matrix: NDArray[np.float64]
    distortion: NDArray[np.float64]

    @classmethod
    def create(
        cls, width: int, height: int, matrix: Any, distortion: Any, model: str = "plumb_bob"
    ) -> Intrinsics:
        """Check the numbers of a calibration and keep them.

        Args:
            width: of the image [px].
            height: of the image [px].
            matrix: nine numbers, row by row [px].
            distortion: 0, 4, 5 or 8 coefficients in OpenCV's order.
            model: `plumb_bob` or `rational_polynomial`.

        Raises:
            CameraError: not calibrated, another model, or impossible numbers.
        """
        k = np.asarray(matrix, dtype=np.float64).reshape(-1)
        if model and model not in PINHOLE_MODELS:
            raise CameraError(
                f"distortion model '{model}': {' and '.join(PINHOLE_MODELS)} are known; calibrate "
                "again with scripts/calibrate_camera.py --rational"
            )
        if width <= 0 or height <= 0:
            raise CameraError(f"camera_info says {width} x {height} px: the size must be positive")
        if k.size != 9 or not np.all(np.isfinite(k)) or k[0] <= 0.0 or k[4] <= 0.0:
            raise CameraError(
                "the camera is not calibrated (its focal length is zero): run "
                "scripts/calibrate_camera.py and publish its result as camera_info, or set "
                "the parameter calibration_file"
            )
        given = np.asarray(distortion, dtype=np.float64).reshape(-1)
        if given.size not in (0, 4, 5, COEFFICIENTS) or not np.all(np.isfinite(given)):
            raise CameraError(
                f"{given.size} distortion coefficients: 0, 4, 5 or 8 finite ones expected"
            )
        coefficients = np.zeros(COEFFICIENTS)
        coefficients[: given.size] = given
        return cls(int(width), int(height), k.reshape(3, 3).copy(), coefficients)

    @classmethod
    def from_yaml(cls, path: str | Path) -> Intrinsics:
        """Read the calibration YAML that ROS's camera drivers use.

        Raises:
            CameraError: the file is missing, malformed or not of a pinhole camera.
        """
        try:
            data = yaml.safe_load(Path(path).read_text())
            return cls.create(
                data["image_width"],
                data["image_height"],
                data["camera_matrix"]["data"],
                data["distortion_coefficients"]["data"],
                data.get("distortion_model", "plumb_bob"),
            )
        except OSError as error:
            raise CameraError(f"cannot read the calibration {path}: {error.strerror}") from error
        except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
            raise CameraError(
                f"{path} is no camera_info YAML ({error}): scripts/calibrate_camera.py writes one"
            ) from error

    def to_yaml(self, path: str | Path) -> None:
        """Write the calibration as the YAML that ROS's camera drivers read."""
        rational = bool(np.any(self.distortion[5:]))
        coefficients = self.distortion if rational else self.distortion[:5]
        projection = np.hstack([self.matrix, np.zeros((3, 1))])

        def block(values: NDArray[np.float64]) -> dict[str, Any]:
            table = np.atleast_2d(values)
            data = [float(value) for value in table.ravel()]
            return {"rows": table.shape[0], "cols": table.shape[1], "data": data}

        content = {
            "image_width": self.width,
            "image_height": self.height,
            "camera_name": "limb_camera",
            "camera_matrix": block(self.matrix),
            "distortion_model": "rational_polynomial" if rational else "plumb_bob",
            "distortion_coefficients": block(coefficients),
            "rectification_matrix": block(np.eye(3)),
            "projection_matrix": block(projection),
        }
        Path(path).write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None))

    def rays(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return normalised coordinates (n, 2) of pixels (n, 2), lens distortion removed."""
        points = np.asarray(pixels, dtype=np.float64).reshape(-1, 1, 2)
        lens = self.matrix, self.distortion
        found = cv2.undistortPointsIter(points, *lens, None, None, UNDISTORTED)
        return np.asarray(found, dtype=np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class CameraPose:
    """Rotation (3, 3) and translation (3,) [m] from `limb_base` into the camera's optical frame."""

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]

    @classmethod
    def looking_down(
        cls,
        position: tuple[float, float, float],
        turn: float,
        tilt: tuple[float, float] = (0.0, 0.0),
    ) -> CameraPose:
        """Return the pose of a camera above the plane.

        Args:
            position: of the camera in `limb_base` [m].
            turn: angle from the base's x axis to the image's right-hand direction [rad].
            tilt: small rotations about the camera's own x and y axes [rad].
        """
        cosine, sine = np.cos(turn), np.sin(turn)
        upright = np.array([[cosine, sine, 0.0], [sine, -cosine, 0.0], [0.0, 0.0, -1.0]])
        tilted = cv2.Rodrigues(np.array([tilt[0], tilt[1], 0.0]))[0] @ upright
        return cls(tilted, -tilted @ np.array(position))

    @property
    def position(self) -> NDArray[np.float64]:
        """Where the camera is in `limb_base`, (3,) m."""
        return np.asarray(-self.rotation.T @ self.translation)

    def onto_plane(self, rays: NDArray[np.float64], height: float) -> NDArray[np.float64]:
        """Return where rays (n, 2) meet the plane at a height [m] over the base, (n, 2) m."""
        directions = rays @ self.rotation[:2] + self.rotation[2]
        origin = self.position
        scale = (height - origin[2]) / directions[:, 2]
        return np.asarray(origin[:2] + scale[:, None] * directions[:, :2])


def project(
    intrinsics: Intrinsics, pose: CameraPose, points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the pixels (n, 2) of points (n, 3) in `limb_base`."""
    turn, _ = cv2.Rodrigues(pose.rotation)
    lens = intrinsics.matrix, intrinsics.distortion
    found, _ = cv2.projectPoints(points, turn, pose.translation, *lens)
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


def solve_pose(
    intrinsics: Intrinsics,
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    start: CameraPose | None = None,
) -> tuple[CameraPose, NDArray[np.float64]]:
    """Find the camera pose that explains all fixed points together.

    Args:
        intrinsics: of the camera.
        points: (n, 3) in `limb_base` [m], n at least 4.
        pixels: (n, 2) where they were seen.
        start: a pose to start from; without it the closed-form SQPnP solution is used.

    Returns:
        The pose and the reprojection residuals (n, 2) px.

    Raises:
        CameraError: no solution, or one that looks at the plane from below (a mirror image, or a
            map with mirrored positions).
    """
    normalised = intrinsics.rays(pixels)
    identity = np.eye(3)
    if start is None:
        found, rotation, translation = cv2.solvePnP(
            points, normalised, identity, None, flags=cv2.SOLVEPNP_SQPNP
        )
        if not found:
            raise CameraError("no camera pose explains the fixed tags: check their positions")
    else:
        rotation, translation = cv2.Rodrigues(start.rotation)[0], start.translation.reshape(3, 1)
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-12)
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, intrinsics.matrix, intrinsics.distortion, rotation, translation, stop
    )
    pose = CameraPose(cv2.Rodrigues(rotation)[0], np.asarray(translation).reshape(3))
    if pose.position[2] <= float(np.max(points[:, 2])):
        raise CameraError(
            "the fixed tags are seen from below: the image is mirrored, or positions in "
            "the tag map are"
        )
    return pose, project(intrinsics, pose, points) - pixels
