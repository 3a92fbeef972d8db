"""Find AprilTags in a grey image: OpenCV finds quadrilaterals, everything else is ours."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera.images import check_grey
from apriltag_tracker.detection.codes import code_table, nearest_tag, read_codes
from apriltag_tracker.detection.edges import refine_quads
from apriltag_tracker.family import TAG36H11, Family

SMALLEST_TAG = 14.0
"""A shorter side is not looked for [px]; a cell of such a tag is 1.75 px wide."""

_SEARCH = 3.0
"""The sides of a tag may be this far from where it is expected [px]."""

_DIM = 60.0
"""A picture is dim if its grey levels span less than this."""

_THRESHOLD, _FAINT_THRESHOLD = 7.0, 3.0
"""A pixel is black if it is darker than its surroundings by this; the second is for dim pictures
[grey levels]."""

_FROM_OPENCV = (1, 0, 3, 2)
"""OpenCV's corners run clockwise; in this order they run as printed."""


_SHARP_MISFIT = 0.05
"""Cells of a sharp picture are off plain black and white by this [half contrasts]."""

_BLENDED = 0.17
"""Where blur or smear blend the cells, those of the code reach over the border: lines are shifted
by this share of a cell for a misfit of one that is beyond `_SHARP_MISFIT`."""

_LARGEST_RESIDUAL = 0.4
"""A candidate is dropped whose border's lines have a larger RMS residual than this [px]."""


@dataclass(frozen=True)
class Tag:
    """One tag in one image.

    Attributes:
        id: within the family.
        corners: (4, 2) px, counter-clockwise from the printed lower left.
        covariance: (8, 8) px² of the corners x0 y0 x1 ….
        line_residual: RMS distance of the border's crossings from its four lines [px].
    """

    id: int
    corners: NDArray[np.float64]
    covariance: NDArray[np.float64]
    line_residual: float

    @property
    def pixel_size(self) -> float:
        """Mean length of the sides [px]."""
        a, b, c, d = self.corners.tolist()
        return (math.dist(a, b) + math.dist(b, c) + math.dist(c, d) + math.dist(d, a)) / 4.0

    def is_at(self, other: Tag) -> bool:
        """Tell whether another tag is at the same place of the image."""
        apart = self.corners.mean(axis=0) - other.corners.mean(axis=0)
        return bool(np.hypot(*apart) < 0.5 * other.pixel_size)


class Detector:
    """Finds all tags of an image.

    Args:
        smallest: shortest side of a tag to look for [px].
        correct_bits: wrong cells of a code that are forgiven in a search; one more where the tag is
            expected; None for what suits the family. A random square passes for a tag of tag36h11
            once in 790 000 at 1, once in 44 000 at 2; of tag25h9 once in 240 000 at 0; of tag16h5
            once in 550 at 0; of tagStandard41h12 once in 300 000 at 2; of tagStandard52h13 once in
            980 000 at 3, once in 78 000 at 4.
        family: of the tags.
    """

    def __init__(
        self,
        smallest: float = SMALLEST_TAG,
        correct_bits: int | None = None,
        family: Family = TAG36H11,
    ) -> None:
        self.family = family
        self.smallest = smallest
        self.correct_bits = family.correct_bits if correct_bits is None else correct_bits

    def detect(self, gray: NDArray[np.uint8], thorough: bool = False) -> list[Tag]:
        """Find the tags of an image (rows, columns) of uint8; an id may be there more than once.

        Args:
            gray: the image.
            thorough: search once more with a lower threshold, for tags in a dark corner of an image
                that is bright elsewhere. An image that is dark as a whole is searched like that
                anyway.

        Raises:
            ValueError: not such an image, or an empty one.
        """
        image = self._read_as(gray)
        passes = (True,) if _is_dim(image) else (False, True) if thorough else (False,)
        tags: list[Tag] = []
        for faint in passes:
            tags += self._read(image, _find_quads(image, self.smallest, faint))
        kept: list[Tag] = []
        for tag in sorted(tags, key=lambda tag: float(np.trace(tag.covariance))):
            if not any(tag.id == other.id and tag.is_at(other) for other in kept):
                kept.append(tag)
        return kept

    def confirm(
        self, gray: NDArray[np.uint8], ids: Sequence[int], corners: NDArray[np.float64]
    ) -> list[Tag]:
        """Return those of n tags that are within a few pixels of where they are expected.

        Args:
            gray: image (rows, columns) of uint8.
            ids: which tags are expected.
            corners: (n, 4, 2) px, from the printed lower left counter-clockwise.

        Raises:
            ValueError: not such an image, or an empty one.
        """
        seen = self._candidates(self._read_as(gray), np.ascontiguousarray(corners))
        expected = code_table(self.family)[0]
        return [
            replace(tag, id=ids[i])
            for i, code, tag in seen
            if np.bitwise_count(expected[ids[i]] ^ code) <= self.correct_bits + 1
        ]

    def _read_as(self, gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return an image in which borders are black: the negative of a family with white ones."""
        gray = check_grey(gray)
        return np.bitwise_not(gray) if self.family.outer_ring else gray

    def _read(self, image: NDArray[np.uint8], quads: NDArray[np.float64]) -> list[Tag]:
        """Read the codes of quadrilaterals (n, 4, 2) px, in whatever direction."""
        tags = []
        for _, code, seen in self._candidates(image, quads):
            tag, turn, wrong = nearest_tag(code, self.family)
            if wrong <= self.correct_bits:
                order = (np.arange(4) + turn) % 4
                both = np.stack([2 * order, 2 * order + 1], axis=1).ravel()
                covariance = seen.covariance[np.ix_(both, both)]
                tags.append(Tag(tag, seen.corners[order], covariance, seen.line_residual))
        return tags

    def _candidates(
        self, image: NDArray[np.uint8], quads: NDArray[np.float64]
    ) -> Iterator[tuple[int, np.uint64, Tag]]:
        """Refine quadrilaterals (n, 4, 2) px and read their cells.

        Those are yielded that have a straight border around clear cells and are no mirror images:
        with their place in ``quads``, their code, and as tags that have no id yet.
        """
        corners, covariances, residuals, found = refine_quads(image, quads, _SEARCH)
        misfits, codes = read_codes(image, corners, self.family)
        along, across = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
        good = found & (residuals <= _LARGEST_RESIDUAL) & (misfits <= self.family.largest_misfit)
        # Corners run as printed, not as in a mirror; y points down in the image.
        turned = along[:, 0] * across[:, 1] - along[:, 1] * across[:, 0]
        good &= turned < 0.0
        # Half of the cross of the diagonals is the area.
        cells = np.sqrt(0.5 * np.abs(turned)) / self.family.border_cells
        shifts = _BLENDED * np.maximum(misfits - _SHARP_MISFIT, 0.0) * cells
        covariances[good] += shifts[good, None, None] ** 2 * np.eye(8)
        for i in np.flatnonzero(good).tolist():
            yield i, codes[i], Tag(-1, corners[i], covariances[i], float(residuals[i]))


def _is_dim(image: NDArray[np.uint8]) -> bool:
    """Tell from 1 pixel of 64 whether nothing stands out against OpenCV's usual threshold."""
    low, high = np.percentile(image[::8, ::8], (1.0, 99.0))
    return bool(high - low < _DIM)


def _find_quads(image: NDArray[np.uint8], smallest: float, faint: bool) -> NDArray[np.float64]:
    """Let OpenCV find dark quadrilaterals; return their corners (n, 4, 2) px, running as printed.

    Args:
        image: grey image.
        smallest: shortest side [px].
        faint: whether to look for tags of little contrast.
    """
    if faint:
        image = np.asarray(cv2.GaussianBlur(image, (3, 3), 0.0), dtype=np.uint8)
    found, _, others = _opencv_detector(max(image.shape), smallest, faint).detectMarkers(image)
    corners = [np.asarray(quad, dtype=np.float64).reshape(4, 2) for quad in (*found, *others)]
    return np.ascontiguousarray(np.array(corners).reshape(-1, 4, 2)[:, _FROM_OPENCV])


@functools.lru_cache(maxsize=32)
def _opencv_detector(extent: int, smallest: float, faint: bool) -> Any:
    """Return OpenCV's detector of quadrilaterals, with a dictionary of a tag that nobody prints."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.minMarkerPerimeterRate = 0.8 * 4.0 * smallest / extent
    parameters.adaptiveThreshConstant = _FAINT_THRESHOLD if faint else _THRESHOLD
    parameters.adaptiveThreshWinSizeMin = 13
    parameters.adaptiveThreshWinSizeMax = 13
    # Else the outline of the white sheet takes the place of the black border inside of it.
    parameters.minMarkerDistanceRate = 0.02
    parameters.minDistanceToBorder = 2
    # Loose, so that a border with a dent where something covers it is still taken for four sides.
    parameters.polygonalApproxAccuracyRate = 0.08
    parameters.perspectiveRemovePixelPerCell = 1
    cells = cv2.aruco.Dictionary.getByteListFromBits(np.zeros((3, 3), dtype=np.uint8))
    return cv2.aruco.ArucoDetector(cv2.aruco.Dictionary(cells, 3, 0), parameters)
