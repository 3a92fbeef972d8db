"""Aligns tags: keeps the tables of patterns, and decides when a smear is to be fitted."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.camera.lens import local_bend
from apriltag_tracker.detection.alignment import fit
from apriltag_tracker.detection.alignment.pattern import Pattern, tabulate
from apriltag_tracker.detection.alignment.sampling import side_length
from apriltag_tracker.detection.alignment.smear import guess_smear
from apriltag_tracker.family import TAG36H11, Family

USUAL_BLUR = 0.65
"""Of a sharp picture, lens and pixel together: where the first fit starts [px]."""

_STEP = 1.09
"""Tables exist for blurs in steps of this ratio; a fit is linear in between."""

_TABLES = 96
_POINTS = 1.7
"""Points of the table in one standard deviation of the blur."""

_SMEARED = 0.12
"""Correlation of neighbouring residuals from which a smear is looked for."""

_SHORTEST = 0.9
"""A shorter smear cannot be told from blur, and is counted as such [px]."""

_PASSES = 9


Lens = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Camera matrix (3, 3) [px] and distortion (8,)."""


@dataclass(frozen=True)
class Alignment:
    """A tag's pattern fitted to its pixels.

    Attributes:
        corners: (4, 2) px.
        covariance: (8, 8) px² of the corners x0 y0 x1 ….
        blur: standard deviation of lens and pixel together [px].
        smear: (2,) px, the way during the exposure; its sign is not known.
        explained: share of the pixels' variance that the pattern explains, covered ones and all.
        kept: share of the weight that was kept: less than 1 where something covers the tag.
        residual: RMS of the pixels that fit [grey levels].
        contrast: white minus black [grey levels].
        alike: correlation of neighbouring residuals; a smear that is not fitted makes them alike.
    """

    corners: NDArray[np.float64]
    covariance: NDArray[np.float64]
    blur: float
    smear: NDArray[np.float64]
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
        self._lens = lens
        self._border = float(family.border_cells)
        self._tables: OrderedDict[tuple[int, int], Pattern] = OrderedDict()

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
        cell = side_length(plain.corners) / self._border
        pattern, bend = self._table(tag, plain.blur / cell), self._bend(plain.corners)
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
        start = np.ascontiguousarray(corners)
        cell, bend = side_length(corners) / self._border, self._bend(start)
        result[0] = blur
        if smear is not None:
            result[1:3], result[8] = smear, turn
        for attempt in range(3):
            pattern, free = self._table(tag, result[0] / cell), smear is not None
            settled = fit.align(
                image, pattern, start, bend, free, _PASSES, placed, covariance, result
            )
            if not settled and attempt > 0:
                return None
            if not np.all(np.isfinite(placed)):
                return None
            if settled and abs(math.log(result[0] / (cell * pattern.blur))) < math.log(_STEP):
                break
            start = placed.copy() if settled else start
        if not settled or not np.all(np.isfinite(covariance)):
            return None
        # Of an arc by an angle a, the mean is nearer to its middle by a² / 24 than the tangent is:
        # through the arc a pixel sees more of the tag's middle, so that the tag looks larger.
        middle = placed.mean(axis=0)
        placed = middle + (placed - middle) * (1.0 - result[8] ** 2 / 24.0)
        return Alignment(
            placed,
            covariance,
            float(result[0]),
            result[1:3].copy(),
            float(result[3]),
            float(result[5]),
            float(result[4]),
            float(result[6]),
            float(result[7]),
        )

    def _bend(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how the lens bends lines at a tag, (6,) 1/px."""
        if self._lens is None:
            return np.zeros(6)
        bend: NDArray[np.float64] = local_bend(corners, *self._lens)
        return bend

    def _table(self, tag: int, blur: float) -> Pattern:
        """Return the table of a tag's pattern nearest to a blur [cells]."""
        level = round(math.log(min(max(blur, 0.04), 2.0)) / math.log(_STEP))
        key = (tag, level)
        if key in self._tables:
            self._tables.move_to_end(key)
            return self._tables[key]
        near = _STEP**level
        resolution = min(max(round(_POINTS / near), 5), 16)
        cells = self._family.seen_cells(tag)
        entry = Pattern(
            tabulate(cells, resolution, near), near, self._border, float(self._family.rim)
        )
        self._tables[key] = entry
        if len(self._tables) > _TABLES:
            self._tables.popitem(last=False)
        return entry
