"""One tag in one image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection.alignment.aligner import USUAL_BLUR


@dataclass(frozen=True)
class Tag:
    """One tag in one image.

    Attributes:
        id: within the family.
        corners: (4, 2) px, counter-clockwise from the printed lower left.
        covariance: (8, 8) px² of the corners x0 y0 x1 …, of the fit of the whole pattern.
        line_residual: RMS distance of the edge points from the four lines [px]; NaN of a tag that
            was found by its pattern alone.
        edge_share: share of the border's profiles that took part, of the worst side; 0 without.
        contrast: white minus black [grey levels].
        found_by: `full`, `tracked`, `expected`, `region` or `still`.
        blur: standard deviation of lens and pixel together [px].
        smear: way during the exposure, x and y [px]; its sign is not known.
    """

    id: int
    corners: NDArray[np.float64]
    covariance: NDArray[np.float64]
    line_residual: float
    edge_share: float
    contrast: float
    found_by: str = "full"
    blur: float = USUAL_BLUR
    smear: tuple[float, float] = (0.0, 0.0)

    @property
    def measured(self) -> bool:
        """Whether the corners are from this picture; else it only shows that nothing has moved."""
        return self.found_by != "still"

    @property
    def centre(self) -> NDArray[np.float64]:
        """Where the diagonals cross, (2,) px: the image of the printed tag's centre."""
        a, b, c, d = self.corners
        along, across = c - a, d - b
        determinant = along[0] * across[1] - along[1] * across[0]
        gap = b - a
        share = (gap[0] * across[1] - gap[1] * across[0]) / determinant
        result: NDArray[np.float64] = a + share * along
        return result

    @property
    def pixel_size(self) -> float:
        """Mean length of the sides [px]."""
        a, b, c, d = self.corners.tolist()
        return (math.dist(a, b) + math.dist(b, c) + math.dist(c, d) + math.dist(d, a)) / 4.0


@dataclass(frozen=True)
class ExpectedTag:
    """Where a tag that was not found yet should be.

    Attributes:
        id: of the tag.
        corners: (4, 2) px.
        smears: (2,) px each, guesses of its way during the exposure, the likeliest first.
    """

    id: int
    corners: NDArray[np.float64]
    smears: tuple[NDArray[np.float64], ...]


def once(tags: Sequence[Tag]) -> list[Tag]:
    """Drop tags that are another one of the list, found twice; the surer of two stays."""
    kept: list[Tag] = []
    for tag in sorted(tags, key=lambda tag: float(np.trace(tag.covariance))):
        if all(
            tag.id != other.id or np.hypot(*(tag.centre - other.centre)) > 0.5 * other.pixel_size
            for other in kept
        ):
            kept.append(tag)
    return kept


def counter_clockwise(corners: NDArray[np.float64]) -> bool:
    """Tell whether corners run as printed; y points down in the image. A mirror image does not."""
    (a, e), (b, f), (c, g), (d, h) = corners.tolist()
    return bool((c - a) * (h - f) - (g - e) * (d - b) < 0.0)
