"""Tags from frame to frame: short searches where tags are expected, full searches now and then.

A tag that was seen is looked for at its predicted corners by the line fit itself, and its code is
read there. A tag too smeared for lines is confirmed by its whole pattern, from the blur and smear
it had. A tag of the limb that is missing is looked for where the limb's other tags say that it is.
When one is still missing, the whole image is searched at once, which costs less than a search
around several predictions. What is still missing is looked for in regions around the predictions,
put together into one mosaic, as it is and then sharpened and enlarged. While all tags are tracked,
a full search runs once a second.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection.detector import Detector, grey
from apriltag_tracker.detection.tag import ExpectedTag, Tag

Expect = Callable[[Sequence[Tag]], Sequence[ExpectedTag]]
"""Says from the tags that were found in an image where others are, the surest first."""

_TILE = 16
"""Tiles of the mosaic are padded to a multiple of this [px]."""


@dataclass
class _Track:
    """What is known of one tag: as it was seen last, and the velocity of its corners."""

    tag: Tag
    velocity: NDArray[np.float64]
    stamp: float
    missed: int = 0


@dataclass(frozen=True)
class TrackingOptions:
    """When to search how.

    Attributes:
        full_search_period: s between full searches while all tags are tracked.
        missing_search_period: s between full searches while a tag is missing that was seen in one
            of the last `keep_frames` frames.
        absent_search_period: s between full searches while a tag of the map is missing for longer,
            e.g. covered; these also look for tags of little contrast.
        search: how far the sides of a tag may be from their prediction [px].
        keep_frames: frames for which a lost tag is still looked for where it was.
        region_growth: half the side of a search region over half the diagonal of the tag; it grows
            by a fifth with every frame in which the tag was not found.
        largest_jump: distance from the prediction beyond which a duplicate is not the tag [tag
            sizes].
    """

    full_search_period: float = 1.0
    missing_search_period: float = 0.0
    absent_search_period: float = 0.1
    search: float = 3.0
    keep_frames: int = 8
    region_growth: float = 1.6
    largest_jump: float = 1.5


@dataclass
class TrackingCounts:
    """How often what happened since the start."""

    frames: int = 0
    full_searches: int = 0
    tracked: int = 0
    by_region: int = 0
    by_full: int = 0
    by_expectation: int = 0
    duplicates: int = 0
    unknown: dict[int, int] = field(default_factory=dict)


class TagTracker:
    """Finds the tags of each frame of a sequence.

    Args:
        wanted: ids of the tags in the map; others are counted and left out.
        detector: finds and confirms tags.
        options: when to search how.
    """

    def __init__(
        self,
        wanted: Collection[int],
        detector: Detector | None = None,
        options: TrackingOptions | None = None,
    ) -> None:
        self._wanted = frozenset(wanted)
        self._detector = detector or Detector()
        self.options = options or TrackingOptions()
        self.counts = TrackingCounts()
        self._tracks: dict[int, _Track] = {}
        self._last_full = self._last_thorough = -np.inf

    def reset(self) -> None:
        """Forget all tracks: the next frame is searched in full."""
        self._tracks.clear()
        self._last_full = self._last_thorough = -np.inf

    def track(
        self, gray: NDArray[np.uint8], stamp: float, expect: Expect | None = None
    ) -> list[Tag]:
        """Find the tags of one frame.

        Args:
            gray: image (rows, columns) of uint8.
            stamp: when it was taken [s]; must grow from call to call, or tracking starts anew.
            expect: says where tags are that were not found, None if nothing is known of that.

        Returns:
            Tags of the map, each id once.
        """
        image = grey(gray)
        self.counts.frames += 1
        if any(
            track.stamp >= stamp or track.stamp < stamp - 1.0 for track in self._tracks.values()
        ):
            self.reset()
        predicted = {tag: self._predict(track, stamp) for tag, track in self._tracks.items()}
        found = self._by_prediction(image, predicted)
        if expect is None:
            self._by_pattern(image, predicted, found)
        self.counts.tracked += len(found)
        self._by_expectation(image, stamp, found, expect)
        known = len(found)
        self._search_in_full(image, stamp, found, predicted)
        if lost := [tag for tag in predicted if tag not in found]:
            self._merge(found, self._by_regions(image, lost, predicted), predicted)
        if len(found) > known:
            self._by_expectation(image, stamp, found, expect)
        self._remember(found, stamp)
        return [found[tag] for tag in sorted(found)]

    def _by_expectation(
        self,
        image: NDArray[np.uint8],
        stamp: float,
        found: dict[int, Tag],
        expect: Expect | None,
    ) -> None:
        """Add tags that are where those that were found say; each one says more about the next.

        A tag that has been hidden for long is not looked for in every frame.
        """
        if expect is None or not found:
            return
        every = stamp - self._last_thorough >= self.options.absent_search_period
        looked_for = self._wanted if every else self._wanted & self._tracks.keys()
        blur = float(np.median([tag.blur for tag in found.values()]))
        more = True
        while more and looked_for - found.keys():
            expected = [tag for tag in expect(list(found.values())) if tag.id in looked_for]
            seen = [self._detector.confirm_expected(image, tag, blur) for tag in expected]
            found.update({tag.id: tag for tag in seen if tag is not None})
            more = 0 < sum(tag is not None for tag in seen) < len(seen)
            self.counts.by_expectation += sum(tag is not None for tag in seen)

    def _search_in_full(
        self,
        image: NDArray[np.uint8],
        stamp: float,
        found: dict[int, Tag],
        predicted: dict[int, NDArray[np.float64]],
    ) -> None:
        """Search the whole image if it is time to."""
        options = self.options
        absent = bool(self._wanted - found.keys() - predicted.keys())
        thorough = absent and stamp - self._last_thorough >= options.absent_search_period
        missing = any(tag not in found for tag in predicted)
        period = options.missing_search_period if missing else options.full_search_period
        if not thorough and stamp - self._last_full < period:
            return
        self._last_full = stamp
        if thorough:
            self._last_thorough = stamp
        self.counts.full_searches += 1
        enough = self._wanted - found.keys()
        self._merge(found, self._detector.detect(image, thorough, enough), predicted)

    @staticmethod
    def _predict(track: _Track, stamp: float) -> NDArray[np.float64]:
        return track.tag.corners + track.velocity * (stamp - track.stamp)

    def _by_prediction(
        self, image: NDArray[np.uint8], predicted: dict[int, NDArray[np.float64]]
    ) -> dict[int, Tag]:
        fresh = [tag for tag in predicted if self._tracks[tag].missed == 0]
        if not fresh:
            return {}
        quads = np.ascontiguousarray([predicted[tag] for tag in fresh])
        ids = np.array(fresh, dtype=np.int64)
        last = {tag: self._tracks[tag].tag for tag in fresh}
        before = {tag: (seen.blur, np.array(seen.smear)) for tag, seen in last.items()}
        tags = self._detector.confirm(image, ids, quads, self.options.search, "tracked", before)
        return {tag.id: tag for tag in tags}

    def _by_pattern(
        self,
        image: NDArray[np.uint8],
        predicted: dict[int, NDArray[np.float64]],
        found: dict[int, Tag],
    ) -> None:
        """Add tags that are too smeared for lines, with the blur and smear that they had."""
        for tag, track in self._tracks.items():
            if tag not in found and track.missed == 0:
                there = ExpectedTag(tag, predicted[tag], (np.array(track.tag.smear),))
                seen = self._detector.confirm_pattern(image, there, track.tag.blur, "tracked")
                found.update({tag: seen} if seen is not None else {})

    def _by_regions(
        self,
        image: NDArray[np.uint8],
        lost: Sequence[int],
        predicted: dict[int, NDArray[np.float64]],
    ) -> list[Tag]:
        """Search around the predictions of lost tags; again sharpened and enlarged."""
        boxes = [
            box for tag in lost if (box := self._region(image, tag, predicted[tag])) is not None
        ]
        if not boxes:
            return []
        mosaic, corners = _mosaic(image, boxes)
        found: list[Tag] = []
        for scale in (1, 2):
            searched = mosaic if scale == 1 else _sharpened(mosaic, scale)
            seen = self._detector.search(searched, "region", scale)
            if not seen:
                continue
            # Back to the whole image, where the corners are refined in pixels as they came.
            quads = (np.array([tag.corners for tag in seen]) + 0.5) / scale - 0.5
            quads = _from_mosaic(quads, boxes, corners)
            ids = np.array([tag.id for tag in seen], dtype=np.int64)
            found = self._detector.confirm(image, ids, quads, 2.5, "region")
            if {tag.id for tag in found} >= set(lost):
                break
        return found

    def _region(
        self, image: NDArray[np.uint8], tag: int, corners: NDArray[np.float64]
    ) -> tuple[int, int, int, int] | None:
        middle = corners.mean(axis=0)
        growth = self.options.region_growth * (1.0 + 0.2 * self._tracks[tag].missed)
        reach = growth * float(np.hypot(*(corners - middle).T).max()) + 8.0
        rows, columns = image.shape
        low = np.floor(middle - reach).astype(int)
        high = np.ceil(middle + reach).astype(int)
        top, bottom = max(low[1], 0), min(high[1], rows)
        left, right = max(low[0], 0), min(high[0], columns)
        if bottom - top < 16 or right - left < 16:
            return None
        return int(top), int(bottom), int(left), int(right)

    def _merge(
        self, found: dict[int, Tag], more: Sequence[Tag], predicted: dict[int, NDArray[np.float64]]
    ) -> None:
        """Add tags of a search to those already found; take duplicates and impossible jumps out."""
        by_id: dict[int, list[Tag]] = {}
        for tag in more:
            if tag.id in self._wanted:
                by_id.setdefault(tag.id, []).append(tag)
            else:
                self.counts.unknown[tag.id] = self.counts.unknown.get(tag.id, 0) + 1
        for tag_id, candidates in by_id.items():
            places = _distinct(candidates)
            if tag_id in found:
                self.counts.duplicates += len(places) > 1
                continue
            if len(places) > 1:
                self.counts.duplicates += 1
                places = self._near(places, predicted.get(tag_id))
                if len(places) != 1:
                    continue
            found[tag_id] = places[0]
            if places[0].found_by == "full":
                self.counts.by_full += 1
            else:
                self.counts.by_region += 1

    def _near(self, tags: Sequence[Tag], predicted: NDArray[np.float64] | None) -> list[Tag]:
        """Return those of several tags with one id that are where it was expected."""
        if predicted is None:
            return []
        middle = predicted.mean(axis=0)
        reach = self.options.largest_jump
        return [
            tag
            for tag in tags
            if float(np.hypot(*(tag.corners.mean(axis=0) - middle))) < reach * tag.pixel_size
        ]

    def _remember(self, found: dict[int, Tag], stamp: float) -> None:
        for tag_id, tag in found.items():
            track = self._tracks.get(tag_id)
            velocity = np.zeros((4, 2))
            if track is not None and stamp > track.stamp:
                velocity = (tag.corners - track.tag.corners) / (stamp - track.stamp)
            self._tracks[tag_id] = _Track(tag, velocity, stamp)
        for tag_id in [tag for tag in self._tracks if tag not in found]:
            track = self._tracks[tag_id]
            track.missed += 1
            if track.missed > self.options.keep_frames:
                del self._tracks[tag_id]


def _distinct(tags: Sequence[Tag]) -> list[Tag]:
    """Drop candidates that are the same tag found twice."""
    kept: list[Tag] = []
    for tag in tags:
        if all(np.hypot(*(tag.centre - other.centre)) > 0.5 * tag.pixel_size for other in kept):
            kept.append(tag)
    return kept


def _mosaic(
    image: NDArray[np.uint8], boxes: Sequence[tuple[int, int, int, int]]
) -> tuple[NDArray[np.uint8], list[tuple[int, int]]]:
    """Put regions of an image side by side; returns the mosaic and each tile's row and column."""
    side = max(max(bottom - top, right - left) for top, bottom, left, right in boxes)
    tile = -(-(side + 4) // _TILE) * _TILE
    across = int(np.ceil(np.sqrt(len(boxes))))
    down = -(-len(boxes) // across)
    mosaic = np.full((down * tile, across * tile), 128, dtype=np.uint8)
    corners = []
    for k, (top, bottom, left, right) in enumerate(boxes):
        row, column = (k // across) * tile, (k % across) * tile
        mosaic[row : row + bottom - top, column : column + right - left] = image[
            top:bottom, left:right
        ]
        corners.append((row, column))
    return mosaic, corners


def _from_mosaic(
    quads: NDArray[np.float64],
    boxes: Sequence[tuple[int, int, int, int]],
    corners: Sequence[tuple[int, int]],
) -> NDArray[np.float64]:
    """Return corners (n, 4, 2) of the mosaic as corners in the image."""
    result = quads.copy()
    starts = np.array(corners, dtype=float)
    for i, quad in enumerate(quads):
        middle = quad.mean(axis=0)
        gaps = middle[::-1] - starts
        inside = np.where((gaps >= 0).all(axis=1), gaps.sum(axis=1), np.inf)
        k = int(np.argmin(inside))
        top, _, left, _ = boxes[k]
        result[i] += (left - corners[k][1], top - corners[k][0])
    return result


def _sharpened(image: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    """Enlarge an image and sharpen it, which brings back tags that motion has smeared."""
    large = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    soft = cv2.GaussianBlur(large, (0, 0), 1.5 * scale)
    result: NDArray[np.uint8] = cv2.addWeighted(large, 2.2, soft, -1.2, 0.0)
    return result
