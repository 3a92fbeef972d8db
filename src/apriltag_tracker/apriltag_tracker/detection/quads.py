"""Quadrilaterals that OpenCV finds in an image, and the lines that place their corners."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection import edges
from apriltag_tracker.family import Family, FamilyError

_FROM_OPENCV = (1, 0, 3, 2)
"""OpenCV's corners run clockwise from what is the printed tag's lower right."""

_THRESHOLD, _FAINT_THRESHOLD = 7.0, 3.0
"""By how much a pixel must be darker than its surroundings to be black [grey levels]."""


def refine(
    gray: NDArray[np.uint8], quads: NDArray[np.float64], search: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Refine corners (n, 4, 2) px; returns corners, side statistics (n, 4, 6) and success (n,)."""
    corners = np.empty_like(quads)
    stats = np.zeros((len(quads), 4, edges.EDGE_VALUES))
    found = np.zeros(len(quads), dtype=np.bool_)
    edges.refine_quads(gray, quads, search, corners, stats, found)
    return corners, stats, found


def find_quads(
    image: NDArray[np.uint8], family: Family, smallest: float, faint: bool = False
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Let OpenCV find tags.

    Args:
        image: grey image.
        family: of the tags.
        smallest: shortest side [px].
        faint: whether to look for tags of little contrast.

    Returns:
        ids (n,) and corners (n, 4, 2) px of tags, printed lower left first; and corners (m, 4, 2)
        of quadrilaterals that it could not read, counter-clockwise as printed.
    """
    detector = _opencv_detector(family, max(image.shape), smallest, faint)
    if faint:
        image = cv2.GaussianBlur(image, (3, 3), 0.0)
    found, ids, others = detector.detectMarkers(image)
    if family.dictionary_id is None:
        # OpenCV finds the borders, but cannot read a code of which it sees the inner part only.
        return np.empty(0, dtype=np.int64), np.empty((0, 4, 2)), _quads([*found, *others])
    rest = _quads(others)
    if ids is None or len(ids) == 0:
        return np.empty(0, dtype=np.int64), np.empty((0, 4, 2)), rest
    return np.asarray(ids, dtype=np.int64).ravel(), _quads(found), rest


def _quads(found: Sequence[Any]) -> NDArray[np.float64]:
    """Return OpenCV's quadrilaterals as an array (n, 4, 2) that runs as printed."""
    if len(found) == 0:
        return np.empty((0, 4, 2))
    table = np.array([np.asarray(quad, dtype=np.float64).reshape(4, 2) for quad in found])
    return np.ascontiguousarray(table[:, _FROM_OPENCV])


@functools.lru_cache(maxsize=32)
def _opencv_detector(family: Family, extent: int, smallest: float, faint: bool) -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.minMarkerPerimeterRate = 0.8 * 4.0 * smallest / extent
    parameters.maxMarkerPerimeterRate = 4.0
    parameters.adaptiveThreshConstant = _FAINT_THRESHOLD if faint else _THRESHOLD
    parameters.adaptiveThreshWinSizeMin = 13
    parameters.adaptiveThreshWinSizeMax = 13
    parameters.adaptiveThreshWinSizeStep = 10
    parameters.minCornerDistanceRate = 0.05
    # Else the outline of the white sheet takes the place of the black border inside of it.
    parameters.minMarkerDistanceRate = 0.02
    parameters.minDistanceToBorder = 2
    # Loose, so that a border with a dent where something covers it is still taken for four sides.
    parameters.polygonalApproxAccuracyRate = 0.08
    parameters.perspectiveRemovePixelPerCell = 4
    parameters.errorCorrectionRate = 1.0
    return cv2.aruco.ArucoDetector(family.dictionary(), parameters)


@functools.cache
def check_orientation(family: Family) -> None:
    """Detect one known tag and check id, corner order, rotation and pixel convention.

    Of a family that OpenCV cannot read, only tag 0 is compared: `Detector.warm_up` detects one.

    Raises:
        family.FamilyError: this OpenCV answers otherwise than this package expects.
    """
    family.check_code_of_tag_0()
    if family.dictionary_id is None:
        return
    scale, left, top = 5, 30, 20
    side = family.border_cells * scale
    canvas = np.full((100, 110), 255, dtype=np.uint8)
    family.draw_tag(canvas, 0, scale, left, top)
    ids, quads, _ = find_quads(canvas, family, 20.0)
    right, bottom = left + side, top + side
    expected = np.array([[left, bottom], [right, bottom], [right, top], [left, top]]) - 0.5
    if list(ids) != [0] or np.abs(quads[0] - expected).max() > 2.0:
        raise FamilyError(
            f"OpenCV {cv2.__version__} finds ids {list(ids)} with corners {quads.tolist()} in a "
            f"picture of tag 0 of {family.name} with corners {expected.tolist()}: its conventions "
            "changed; install opencv-python-headless 4.14 or 5.0"
        )
    corners, _, found = refine(canvas, quads, 3.0)
    if not found[0] or np.abs(corners[0] - expected).max() > 0.05:
        raise FamilyError(
            f"the line fit places the corners of a perfect tag at {corners[0].tolist()}, not at "
            f"{expected.tolist()}"
        )
