"""Calibrate a camera with a ChArUco board, and the tags' mounting with the straight limb."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from apriltag_tracker.camera.pinhole import Intrinsics
from apriltag_tracker.pipeline import LimbTracker
from apriltag_tracker.sheets import BoardLayout
from apriltag_tracker.tag_map import TagMap

Array = NDArray[np.float64]

LEAST_VIEWS = 8
_LEAST_CORNERS = 12
_OUTLIER = 2.5
_GRID = (4, 3)


class CalibrationError(RuntimeError):
    """The pictures do not determine what is asked for; the message says what to take instead."""


@dataclass(frozen=True)
class BoardView:
    """Chessboard corners seen in one picture.

    Attributes:
        name: of the picture.
        pixels: (n, 2) px.
        points: (n, 3) m on the board.
    """

    name: str
    pixels: Array
    points: Array


@dataclass(frozen=True)
class CameraCalibration:
    """A calibration and how good it is.

    Attributes:
        intrinsics: the result.
        rms: reprojection error of all corners [px].
        pictures: how many were used.
        left_out: pictures that did not fit, or showed too little, with the reason.
        sigma: (4,) standard deviations of fx, fy, cx, cy [px].
        covered: share of the picture's area in which corners were seen, in twelfths.
    """

    intrinsics: Intrinsics
    rms: float
    pictures: int
    left_out: dict[str, str]
    sigma: Array
    covered: float


class BoardFinder:
    """Finds a ChArUco board in pictures."""

    def __init__(self, layout: BoardLayout) -> None:
        self._board = layout.board()
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, image: NDArray[np.uint8], name: str) -> BoardView | None:
        """Return the corners of the board in a grey image, None if fewer than twelve are seen."""
        corners, ids, _, _ = self._detector.detectBoard(image)
        if ids is None or len(ids) < _LEAST_CORNERS:
            return None
        # Saddle points to a few hundredths of a pixel, in a window that no marker reaches into.
        pixels = np.ascontiguousarray(corners, dtype=np.float32).reshape(-1, 1, 2)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-4)
        pixels = cv2.cornerSubPix(image, pixels, (4, 4), (-1, -1), stop)
        points = np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        chosen = np.asarray(ids, dtype=np.int64).ravel()
        return BoardView(name, np.asarray(pixels, np.float64).reshape(-1, 2), points[chosen])


def calibrate_camera(
    views: Sequence[BoardView],
    width: int,
    height: int,
    rational: bool = False,
    unseen: Iterable[str] = (),
) -> CameraCalibration:
    """Find focal lengths, principal point and distortion from views of a flat board.

    Views whose error is far above the others' are left out and the rest is solved again.

    Args:
        views: of the board, in different places and tilted in different ways.
        width: of the pictures [px].
        height: of the pictures [px].
        rational: use eight distortion coefficients, for wide lenses.
        unseen: names of pictures in which no board was found, for the report.

    Raises:
        CalibrationError: too few views, or all from the same direction.
    """
    left_out = dict.fromkeys(unseen, "no board seen, or less than twelve of its corners")
    used = list(views)
    while True:
        if len(used) < LEAST_VIEWS:
            raise CalibrationError(
                f"{len(used)} usable pictures of the board: take {LEAST_VIEWS} at least, better "
                "20, tilted by 20 to 40 degrees in all directions and spread over the whole image; "
                "are they sharp, and is the board the one of --columns, --rows and --square?"
            )
        rms, matrix, distortion, tilts, sigma, errors = _solve(used, width, height, rational)
        worst = int(np.argmax(errors))
        if errors[worst] < _OUTLIER * np.median(errors) or errors[worst] < 0.1:
            break
        left_out[used[worst].name] = f"error of {errors[worst]:.2f} px"
        del used[worst]
    spread = float(np.degrees(np.ptp(tilts, axis=0).max()))
    if spread < 10.0:
        raise CalibrationError(
            f"all pictures show the board from nearly the same direction (within {spread:.0f} "
            "degrees): focal length and distance cannot be told apart; tilt the board "
            "by 20 to 40 degrees"
        )
    return CameraCalibration(
        intrinsics=Intrinsics.create(width, height, matrix, distortion),
        rms=rms,
        pictures=len(used),
        left_out=left_out,
        sigma=sigma[:4],
        covered=_coverage(used, width, height),
    )


def _solve(
    views: Sequence[BoardView], width: int, height: int, rational: bool
) -> tuple[float, Array, Array, Array, Array, Array]:
    """Run OpenCV's solver: RMS, matrix, distortion, tilts (v, 2) rad, sigmas, errors (v,) px."""
    flags = cv2.CALIB_RATIONAL_MODEL if rational else 0
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32).reshape(-1, 1, 2) for view in views]
    rms, matrix, distortion, rotations, _, sigma, _, errors = cv2.calibrateCameraExtended(
        points, pixels, (width, height), None, None, flags=flags
    )
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    tilts = np.arctan2(normals[:, :2], np.abs(normals[:, 2:3])) * np.sign(normals[:, 2:3])
    count = 8 if rational else 5
    return rms, matrix, distortion.ravel()[:count], tilts, sigma.ravel(), errors.ravel()


def _coverage(views: Sequence[BoardView], width: int, height: int) -> float:
    x, y = np.vstack([view.pixels for view in views]).T
    seen, _, _ = np.histogram2d(x, y, _GRID, ((0, width), (0, height)))
    return float(np.mean(seen > 0))


@dataclass(frozen=True)
class MountingCalibration:
    """Mounting of every tag, by id.

    Attributes:
        offsets: (3,) along, across [m], turn [rad].
        scatter: (3,) their standard deviations between pictures.
        pictures: how many there were.
    """

    offsets: dict[int, Array]
    scatter: dict[int, Array]
    pictures: int


def calibrate_mounting(
    images: Iterable[NDArray[np.uint8]], tags: TagMap, intrinsics: Intrinsics
) -> MountingCalibration:
    """Measure where the limb tags really sit, from pictures of the straight limb.

    The limb must lie straight along x of `limb_base`: what a tag's pose differs from (arc length,
    0, 0) is then its mounting.

    Raises:
        CalibrationError: no picture gave a camera pose, or a limb tag was never seen.
    """
    tracker = LimbTracker(tags, intrinsics)
    seen: dict[int, list[Array]] = {tag.id: [] for tag in tags.limb}
    count = 0
    for count, image in enumerate(images, 1):
        observation = tracker.observe(image, float(count))
        for placed in observation.tags:
            if placed.on_limb and placed.pose is not None:
                seen[placed.tag.id].append(placed.pose)
    if tracker.world.pose is None:
        raise CalibrationError(f"no camera pose in {count} pictures: {tracker.world.problem}")
    never = [tag for tag, poses in seen.items() if not poses]
    if never:
        raise CalibrationError(f"limb tags {never} were in none of {count} pictures")
    offsets, scatter = {}, {}
    for tag in tags.limb:
        poses = np.array(seen[tag.id])
        offsets[tag.id] = np.median(poses, axis=0) - (tag.arc_length, 0.0, 0.0)
        scatter[tag.id] = poses.std(axis=0)
    return MountingCalibration(offsets, scatter, count)


def with_offsets(text: str, result: MountingCalibration) -> str:
    """Return the text of a tag map with new offsets; the comments at its head stay."""
    head = itertools.takewhile(lambda line: line.startswith("#"), text.splitlines(keepends=True))
    content = yaml.safe_load(text)
    for tag in content["limb"]["tags"]:
        along, across, turn = result.offsets[tag["id"]].tolist()
        tag["offset"] = [round(along, 6), round(across, 6), round(turn, 5)]
    return "".join(head) + yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
