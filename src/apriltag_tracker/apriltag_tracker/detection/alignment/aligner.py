"""Aligns tags: keeps the tables of patterns, and decides when a smear is to be fitted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera.lens import COEFFICIENTS, local_bend
from apriltag_tracker.detection.alignment import fit
from apriltag_tracker.detection.alignment.pattern import Pattern, framed
from apriltag_tracker.detection.alignment.sampling import side_length
from apriltag_tracker.detection.alignment.smear import guess_smear
from apriltag_tracker.family import TAG36H11, Family

USUAL_BLUR = 0.65
"""Of a sharp picture, lens and pixel together: where the first fit starts [px]."""

_SMEARED = 0.12
"""Correlation of neighbouring residuals from which a smear is looked for."""

_SHORTEST = 0.9
"""A shorter smear cannot be told from blur, and is counted as such [px]."""

Lens = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Camera matrix (3, 3) [px] and distortion (8,)."""


@dataclass(frozen=True)
class Alignment:
    """A tag's pattern fitted to its pixels.

    Attributes:
        corners: (4, 2) px.
        covariance: (8, 8) px² of the corners x0 y0 x1 ….
        blur: standard deviation of lens and pixel together [px].
        smear: x and y of the way during the exposure [px]; its sign is not known.
        explained: share of the pixels' variance that the pattern explains, covered ones and all.
        kept: share of the weight that was kept: less than 1 where something covers the tag.
        residual: RMS of the pixels that fit [grey levels].
        contrast: white minus black [grey levels].
        alike: correlation of neighbouring residuals; a smear that is not fitted makes them alike.
    """

    corners: NDArray[np.float64]
    covariance: NDArray[np.float64]
    blur: float
    smear: tuple[float, float]
    explained: float
    kept: float
    residual: float
    contrast: float
    alike: float

    @property
    def complete(self) -> bool:
        """Whether no smear, and no other one, is missing in the fit, as its residuals show."""
        return self.alike < _SMEARED


class Aligner:
    """Fits patterns of tags to pictures; remembers the tables that this takes.

    Args:
        family: of the tags.
        lens: camera matrix (3, 3) [px] and distortion (8,) of the pictures, whose bend of a tag's
            sides is taken into account; None for pictures without distortion.
    """

    def __init__(self, family: Family = TAG36H11, lens: Lens | None = None) -> None:
        self._family = family
        self._lens = lens or (np.eye(3), np.zeros(COEFFICIENTS))
        self._border = float(family.border_cells)
        self._patterns: dict[int, Pattern] = {}

    def align(
        self,
        image: NDArray[np.uint8],
        tag: int,
        corners: NDArray[np.float64],
        blur: float = USUAL_BLUR,
        smear: NDArray[np.float64] | None = None,
    ) -> Alignment | None:
        """Fit one tag.

        Args:
            image: grey image.
            tag: id within the family.
            corners: (4, 2) px to start from, within about half a cell.
            blur: standard deviation to start from [px].
            smear: (2,) px to start from, None if nothing is known of it.

        Returns:
            The fit, None if there is none.
        """
        if smear is not None and math.hypot(*smear) >= _SHORTEST:
            known = self._fit(image, tag, corners, blur, smear)
            if known is not None and known.complete:
                return known
        plain = self._fit(image, tag, corners, blur, None)
        if plain is None:
            return self._from_all_sides(image, tag, corners)
        return plain if plain.complete else self._completed(image, tag, plain)

    def _completed(self, image: NDArray[np.uint8], tag: int, plain: Alignment) -> Alignment:
        """Return the best of a fit without a smear and fits with what may be missing in it."""
        best = plain
        smeared = self._smeared(image, tag, plain)
        if smeared is None:
            smeared = self._turned(image, tag, plain)
        if smeared is not None and smeared.residual < 0.98 * best.residual:
            best = smeared
        if best.explained < 0.93 and best.kept > 0.97 and plain.alike > 0.5:
            searched = self._from_all_sides(image, tag, plain.corners)
            if searched is not None and searched.residual < 0.9 * best.residual:
                best = searched
        return best

    def align_near(
        self,
        image: NDArray[np.uint8],
        tag: int,
        corners: NDArray[np.float64],
        blur: float,
        smear: NDArray[np.float64],
    ) -> Alignment | None:
        """Fit one tag whose place is known to a third of a cell, with about the smear it had."""
        fitted = self.align_once(image, tag, corners, blur, smear)
        if fitted is None or fitted.complete:
            return fitted
        plain = self._fit(image, tag, fitted.corners, blur, None)
        return None if plain is None else self._completed(image, tag, plain)

    def align_once(
        self,
        image: NDArray[np.uint8],
        tag: int,
        corners: NDArray[np.float64],
        blur: float,
        smear: NDArray[np.float64],
    ) -> Alignment | None:
        """Fit one tag from where it is expected, with its smear; nothing else is tried."""
        known = smear if math.hypot(*smear) >= _SHORTEST else None
        return self._fit(image, tag, corners, blur, known)

    def _smeared(self, image: NDArray[np.uint8], tag: int, plain: Alignment) -> Alignment | None:
        pattern, bend = self._pattern(tag), local_bend(plain.corners, *self._lens)
        guess = np.zeros(2)
        blur = guess_smear(image, pattern, plain.corners, bend, plain.blur, guess)
        if math.hypot(*guess) < _SHORTEST:
            return None
        return self._fit(image, tag, plain.corners, max(blur, 0.5), guess)

    def _turned(self, image: NDArray[np.uint8], tag: int, plain: Alignment) -> Alignment | None:
        """Try a turn without a smear, by which the corners went two pixels."""
        turn = 2.0 / (math.sqrt(0.5) * side_length(plain.corners))
        return self._fit(image, tag, plain.corners, plain.blur, np.zeros(2), turn)

    def _from_all_sides(
        self, image: NDArray[np.uint8], tag: int, corners: NDArray[np.float64]
    ) -> Alignment | None:
        """Try smears in eight directions of half a turn; the best fit counts."""
        best: Alignment | None = None
        length = 1.6 * side_length(corners) / self._border
        for k in range(8):
            angle = k * math.pi / 8.0
            smear = length * np.array([math.cos(angle), math.sin(angle)])
            found = self._fit(image, tag, corners, USUAL_BLUR, smear)
            if found is not None and (best is None or found.residual < best.residual):
                best = found
        return best

    def _fit(
        self,
        image: NDArray[np.uint8],
        tag: int,
        corners: NDArray[np.float64],
        blur: float,
        smear: NDArray[np.float64] | None,
        turn: float = 0.0,
    ) -> Alignment | None:
        """Fit with or without smear and turn."""
        result = np.zeros(fit.RESULT_VALUES)
        placed, covariance = np.empty((4, 2)), np.empty((8, 8))
        result[0] = blur
        if smear is not None:
            result[1:3], result[8] = smear, turn
        matrix, distortion = self._lens
        if not fit.place(
            image,
            self._pattern(tag),
            np.ascontiguousarray(corners),
            matrix,
            distortion,
            smear is not None,
            placed,
            covariance,
            result,
        ):
            return None
        width, by_x, by_y, explained, residual, kept, gain, alike, _ = result.tolist()
        return Alignment(
            placed, covariance, width, (by_x, by_y), explained, kept, residual, gain, alike
        )

    def _pattern(self, tag: int) -> Pattern:
        if tag not in self._patterns:
            cells = framed(self._family.seen_cells(tag))
            self._patterns[tag] = Pattern(cells, self._border, float(self._family.rim))
        return self._patterns[tag]
