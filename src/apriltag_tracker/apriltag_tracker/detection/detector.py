"""Find AprilTags in a grey image: OpenCV finds them, fits of lines and patterns place them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection import decoding, edges
from apriltag_tracker.detection.alignment.aligner import USUAL_BLUR, Aligner, Alignment, Lens
from apriltag_tracker.detection.covered import covered_quads
from apriltag_tracker.detection.picture import grey, is_dim
from apriltag_tracker.detection.quads import check_orientation, find_quads, refine
from apriltag_tracker.detection.smeared import read_smeared
from apriltag_tracker.detection.tag import ExpectedTag, Tag, counter_clockwise, once
from apriltag_tracker.family import Family, FamilyError, named

SMALLEST_TAG = 12.0
"""Shortest side that is looked for [px]; a cell is 1.5 px then."""

_LINES_ALONE = 0.15
"""Standard deviation that lines have where the whole pattern could not be fitted [px]."""

_USUAL = (USUAL_BLUR, np.zeros(2))
"""Blur and smear where nothing is known of them [px]."""


class Detector:
    """Finds all tags of an image.

    Args:
        smallest: shortest side of a tag to look for [px].
        correct_bits: wrong cells of a code that are forgiven in a search; one more where the tag is
            expected; None for what suits the family. A random square passes for a tag of tag36h11
            once in 790 000 at 1, once in 44 000 at 2; of tag25h9 once in 240 000 at 0; of tag16h5
            once in 550 at 0; of tagStandard41h12 once in 300 000 at 2; of tagStandard52h13 once in
            980 000 at 3, once in 78 000 at 4.
        largest_residual: RMS residual of the border's lines above which a candidate is dropped
            [px].
        family: of the tags, or its name.

    Raises:
        ValueError: a tag smaller than can be read, or more forgiven cells than are safe.
    """

    def __init__(
        self,
        smallest: float = SMALLEST_TAG,
        correct_bits: int | None = None,
        largest_residual: float = 0.4,
        family: Family | str = "tag36h11",
    ) -> None:
        if smallest < 8.0:
            raise ValueError(f"smallest tag of {smallest} px: 8 px or more can be read")
        self.family = named(family) if isinstance(family, str) else family
        if correct_bits is None:
            correct_bits = self.family.correct_bits
        if not 0 <= correct_bits <= self.family.most_corrected:
            raise ValueError(
                f"correct_bits {correct_bits}: 0 to {self.family.most_corrected} with "
                f"{self.family.name}; with more, pictures without a tag show some"
            )
        self.smallest = smallest
        self.correct_bits = correct_bits
        self.largest_residual = largest_residual
        self._aligner = Aligner(self.family)
        check_orientation(self.family)

    def through(self, lens: Lens) -> Detector:
        """Return a detector like this for pictures of a lens, whose bend of the sides it knows."""
        other = copy(self)
        other._aligner = Aligner(self.family, lens)
        return other

    def warm_up(self) -> None:
        """Load or compile everything a first image would wait for."""
        canvas = np.full((96, 96), 255, dtype=np.uint8)
        end = 28 + 5 * self.family.border_cells
        self.family.draw_tag(canvas, 0, 5, 28, 28)
        if [tag.id for tag in self.detect(canvas)] != [0]:
            raise FamilyError(f"a perfect picture of {self.family.name} 0 is not detected")
        low, high = 27.5, end - 0.5
        quad = np.array([[[low, high], [high, high], [high, low], [low, low]]])
        if [tag.id for tag in self._read_again(self.seen(canvas), quad, [], "full")] != [0]:
            raise FamilyError(f"a perfect picture of {self.family.name} 0 is not read")

    def seen(self, image: Any) -> NDArray[np.uint8]:
        """Return an image as all methods but `detect` take it: grey, with tags' borders black.

        Of a family with a white border this is the negative.

        Raises:
            ValueError: not such an image, or an empty one.
        """
        gray = grey(image)
        return np.bitwise_not(gray) if self.family.outer_ring else gray

    def detect(
        self,
        gray: NDArray[np.uint8],
        thorough: bool = False,
        enough: Collection[int] | None = None,
    ) -> list[Tag]:
        """Find tags in an image (rows, columns) of uint8; duplicates are returned as they are.

        Args:
            gray: the image.
            thorough: search once more with a lower threshold, for tags in a dark corner of an image
                that is bright elsewhere. An image that is dark as a whole is searched like that
                anyway.
            enough: ids of tags; once all of these are found, covered and smeared tags are not
                looked for.

        Raises:
            ValueError: not such an image, or an empty one.
        """
        return self.search(self.seen(gray), "full", 1, thorough, enough)

    def search(
        self,
        image: NDArray[np.uint8],
        found_by: str,
        scale: int = 1,
        thorough: bool = False,
        enough: Collection[int] | None = None,
    ) -> list[Tag]:
        """Find tags in an image of `seen` that may have been enlarged by a whole number.

        Corners belong to the image as given. Quadrilaterals whose code OpenCV does not read are
        read again at their refined corners, where many more are readable; so are dark shapes that
        something covers a corner of.
        """
        smallest = self.smallest * scale
        dim = is_dim(image)
        passes = (True,) if dim else (False, True) if thorough else (False,)
        tags: list[Tag] = []
        for faint in passes:
            ids, quads, others = find_quads(image, self.family, smallest, faint)
            tags += self.confirm(image, ids, quads, 3.0 * scale, found_by)
            tags += self._read_again(image, others, tags, found_by)
        if enough is not None and {tag.id for tag in tags} >= set(enough):
            return once(tags)
        covered = covered_quads(image, smallest, [tag.corners for tag in tags])
        tags += self._read_again(image, covered, tags, found_by)
        tags += self._read_smeared(image, covered, tags, found_by)
        return once(tags)

    def confirm(
        self,
        image: NDArray[np.uint8],
        ids: NDArray[np.int64],
        quads: NDArray[np.float64],
        search: float,
        found_by: str,
        before: Mapping[int, tuple[float, NDArray[np.float64]]] | None = None,
    ) -> list[Tag]:
        """Refine candidates and keep those whose border is straight and whose code is right.

        Args:
            image: grey image.
            ids: (n,) the tag each candidate should be.
            quads: (n, 4, 2) px, from the printed lower left counter-clockwise.
            search: how far a side may be from where the candidate says [px].
            found_by: noted in the tags.
            before: blur and smear (2,) px of tags, where they are known about: fits start there.
        """
        if len(ids) == 0:
            return []
        known = before or {}
        corners, stats, found = refine(image, quads, search)
        distance = np.empty(len(ids), dtype=np.int64)
        expected = decoding.code_table(self.family)[0, ids]
        decoding.distances(image, corners, self.family.layout, expected, found, distance)
        forgiven = self.correct_bits + (found_by in {"tracked", "expected"})
        tags = self._collect(ids, corners, stats, found & (distance <= forgiven), found_by)
        aligned = (self._aligned(image, tag, *known.get(tag.id, _USUAL)) for tag in tags)
        return [tag for tag in aligned if tag is not None]

    def confirm_at_once(
        self, image: NDArray[np.uint8], corners: NDArray[np.float64], before: Tag
    ) -> Tag | None:
        """Return a tag whose whole pattern fits where it is predicted, None if it does not.

        Args:
            image: grey image.
            corners: (4, 2) px, predicted to a third of a cell.
            before: the tag as it was seen last; blur and smear start from that.
        """
        smear = np.array(before.smear)
        fitted = self._aligner.align_near(image, before.id, corners, before.blur, smear)
        if fitted is None or not self._is_the_tag(fitted, corners):
            return None
        return _tag_of(before.id, fitted, "tracked")

    def confirm_expected(
        self, image: NDArray[np.uint8], expected: ExpectedTag, blur: float
    ) -> Tag | None:
        """Return a tag that is where, and smeared as, it is expected; None if it is not there.

        Args:
            image: grey image.
            expected: the tag.
            blur: of other tags in the picture [px].
        """
        smear = expected.smears[0]
        cell = math.dist(*expected.corners[:2].tolist()) / self.family.border_cells
        if math.hypot(*smear) > cell:
            whole = self.confirm_pattern(image, expected, blur, "expected")
            if whole is not None:
                return whole
        ids, quads = np.array([expected.id]), expected.corners[None].copy()
        lines = self.confirm(image, ids, quads, 3.0, "expected", {expected.id: (blur, smear)})
        return lines[0] if lines else None

    def confirm_pattern(
        self, image: NDArray[np.uint8], expected: ExpectedTag, blur: float, found_by: str
    ) -> Tag | None:
        """Return a tag whose whole pattern fits from where it is expected, None if none does.

        It may be too smeared for lines. Arguments are those of `confirm_expected`.
        """
        for smear in expected.smears:
            fitted = self._aligner.align_once(image, expected.id, expected.corners, blur, smear)
            if fitted is not None and self._is_the_tag(fitted, expected.corners):
                return _tag_of(expected.id, fitted, found_by)
        return None

    def _aligned(
        self, image: NDArray[np.uint8], tag: Tag, blur: float, smear: NDArray[np.float64]
    ) -> Tag | None:
        """Return a tag with the corners of its whole pattern, which a smear does not shift.

        None if the family's codes are too weak without the pattern, and that is not there.
        """
        fitted = self._aligner.align(image, tag.id, tag.corners, blur, smear)
        if self.family.needs_pattern and (
            fitted is None or not self._is_the_tag(fitted, tag.corners)
        ):
            return None
        cell = tag.pixel_size / self.family.border_cells
        if fitted is None or not (
            np.abs(fitted.corners - tag.corners).max() < 0.3 * cell + 1.0
            or self._is_the_tag(fitted, tag.corners)
            or _fits_but_for_a_cover(fitted, tag.corners, cell)
        ):
            # Lines alone: blur and smear may have moved them, by how much is not known.
            unsure = 4.0 * tag.covariance + _LINES_ALONE**2 * np.eye(8)
            return replace(tag, covariance=unsure)
        return replace(
            tag,
            corners=fitted.corners,
            covariance=fitted.covariance,
            contrast=fitted.contrast,
            blur=fitted.blur,
            smear=fitted.smear,
        )

    def _by_pattern(
        self,
        image: NDArray[np.uint8],
        tag: int,
        quad: NDArray[np.float64],
        blur: float,
        smear: NDArray[np.float64],
        found_by: str,
    ) -> Tag | None:
        """Return a tag that is confirmed by nearly all of its pixels, None if it is not there."""
        fitted = self._aligner.align(image, tag, quad, blur, smear)
        if fitted is None or not self._is_the_tag(fitted, quad):
            return None
        return _tag_of(tag, fitted, found_by)

    def _read_again(
        self,
        image: NDArray[np.uint8],
        quads: NDArray[np.float64],
        known: Sequence[Tag],
        found_by: str,
    ) -> list[Tag]:
        """Refine quadrilaterals (n, 4, 2) that OpenCV could not read, and read them."""
        quads = _elsewhere(quads, known)
        if len(quads) == 0:
            return []
        corners, stats, found = refine(image, quads, 3.0)
        ids, turns, distance = (np.zeros(len(quads), dtype=np.int64) for _ in range(3))
        table, layout = decoding.code_table(self.family), self.family.layout
        decoding.identify(image, corners, layout, table, found, ids, turns, distance)
        for i in np.flatnonzero(distance < decoding.UNREADABLE):
            corners[i] = np.roll(corners[i], -turns[i], axis=0)
            stats[i] = np.roll(stats[i], -turns[i], axis=0)
        good = found & (distance <= self.correct_bits)
        tags = self._collect(ids, corners, stats, good, found_by)
        aligned = (self._aligned(image, tag, *_USUAL) for tag in tags)
        tags = [tag for tag in aligned if tag is not None]
        for i in np.flatnonzero(found & ~good & (distance <= self.family.most_wrong)):
            if counter_clockwise(corners[i]):
                whole = self._by_pattern(image, int(ids[i]), corners[i], *_USUAL, found_by)
                tags += [whole] if whole is not None else []
        return tags

    def _read_smeared(
        self,
        image: NDArray[np.uint8],
        quads: NDArray[np.float64],
        known: Sequence[Tag],
        found_by: str,
    ) -> list[Tag]:
        """Read quadrilaterals (n, 4, 2) whose cells run into each other, as a smear makes them."""
        tags: list[Tag] = []
        for quad in _elsewhere(quads, known):
            code = read_smeared(image, quad, self.family)
            if code is not None:
                start = np.roll(quad, -code.turn, axis=0)
                whole = self._by_pattern(image, code.id, start, USUAL_BLUR, code.smear, found_by)
                tags += [whole] if whole is not None else []
        return tags

    def _is_the_tag(self, fitted: Alignment, quad: NDArray[np.float64]) -> bool:
        """Tell whether a pattern explains nearly all pixels, close to where it was looked for."""
        cell = math.dist(quad[0].tolist(), quad[2].tolist()) / (
            math.sqrt(2.0) * self.family.border_cells
        )
        return (
            fitted.explained > self.family.explained
            and fitted.contrast > 12.0
            and counter_clockwise(fitted.corners)
            and float(np.abs(fitted.corners - quad).max()) < 1.5 * cell
        )

    def _collect(
        self,
        ids: NDArray[np.int64],
        corners: NDArray[np.float64],
        stats: NDArray[np.float64],
        good: NDArray[np.bool_],
        found_by: str,
    ) -> list[Tag]:
        """Put together those candidates whose border is straight and runs the right way round."""
        residuals = np.sqrt(np.mean(stats[:, :, 3] ** 2, axis=1))
        good = good & (residuals <= self.largest_residual)
        kept = [i for i in np.flatnonzero(good) if counter_clockwise(corners[i])]
        spread = np.empty((len(kept), 8, 8))
        edges.corner_covariances(corners[kept], stats[kept], spread)
        return [
            Tag(
                id=int(ids[i]),
                corners=corners[i],
                covariance=spread[k],
                line_residual=float(residuals[i]),
                edge_share=float(stats[i, :, 4].min()),
                contrast=float(stats[i, :, 5].min()),
                found_by=found_by,
            )
            for k, i in enumerate(kept)
        ]


def _elsewhere(quads: NDArray[np.float64], known: Sequence[Tag]) -> NDArray[np.float64]:
    """Return those of quadrilaterals (n, 4, 2) that are not where a tag is known."""
    for tag in known:
        apart = np.hypot(*(quads.mean(axis=1) - tag.corners.mean(axis=0)).T)
        quads = quads[apart > 0.5 * tag.pixel_size]
    return quads


def _tag_of(tag: int, fitted: Alignment, found_by: str) -> Tag:
    """Return a tag of whose border no lines were fitted."""
    return Tag(
        id=tag,
        corners=fitted.corners,
        covariance=fitted.covariance,
        line_residual=math.nan,
        edge_share=0.0,
        contrast=fitted.contrast,
        found_by=found_by,
        blur=fitted.blur,
        smear=fitted.smear,
    )


def _fits_but_for_a_cover(fitted: Alignment, lines: NDArray[np.float64], cell: float) -> bool:
    """Tell whether a pattern fits closely where nothing covers it, though lines are elsewhere.

    A light cover on a corner takes lines along its own edge.
    """
    return (
        fitted.kept > 0.8
        and fitted.residual < 0.06 * fitted.contrast
        and bool(np.abs(fitted.corners - lines).max() < 1.5 * cell)
    )
