"""Tags from frame to frame: short searches where tags are expected, full searches now and then.

A tag that was seen is fitted at once by its whole pattern, where its last pictures foresee it, with
the blur and smear that it had. Where that does not fit, lines are fitted to its border and its code
is read there. Tags that do not move are fitted in turn, and only looked at in between; one that
looks different is fitted in the same picture. A tag of the limb that is missing is looked for where
the limb's other tags say that it is. When one is still missing, the whole image is searched at
once, which costs less than a search around several predictions. What is still missing is looked for
in regions around the predictions, put together into one mosaic, as it is and then sharpened and
enlarged. While all tags are tracked, a full search runs once a second.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection.detector import Detector
from apriltag_tracker.detection.regions import from_mosaic, mosaic_of, sharpened
from apriltag_tracker.detection.still import look_at_borders, unmoved
from apriltag_tracker.detection.tag import ExpectedTag, Tag
from apriltag_tracker.detection.track import Track

Expect = Callable[[Sequence[Tag]], Sequence[ExpectedTag]]
"""Says from the tags that were found in an image where others are, the surest first."""

_MOVED = 0.3
"""A fixed tag whose corners differ by more from one fit to the next has moved [px]."""


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
        still_after: pictures in which a tag that does not move is fitted; after these, one such tag
            is fitted in every picture, in turn, and the others are only looked at.
    """

    full_search_period: float = 1.0
    missing_search_period: float = 0.0
    absent_search_period: float = 0.1
    search: float = 3.0
    keep_frames: int = 8
    region_growth: float = 1.6
    largest_jump: float = 1.5
    still_after: int = 30


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
        still: ids of tags that do not move as long as nobody moves the camera.
    """

    def __init__(
        self,
        wanted: Collection[int],
        detector: Detector | None = None,
        options: TrackingOptions | None = None,
        still: Collection[int] = (),
    ) -> None:
        self._wanted = frozenset(wanted)
        self._still = frozenset(still)
        self._detector = detector or Detector()
        self.options = options or TrackingOptions()
        self.counts = TrackingCounts()
        self._tracks: dict[int, Track] = {}
        self._fits: dict[int, int] = {}
        """Fits in a row in which a fixed tag has not moved."""
        self._looks: dict[int, tuple[int, NDArray[np.float64]]] = {}
        """In which frame a fixed tag was fitted last, and how its border looked, (4, 2)."""
        self._postponed: dict[int, Tag] | None = None
        """What was found in the last image, if its full search was left for later."""
        self._last_full = self._last_thorough = -np.inf

    def reset(self) -> None:
        """Forget all tracks: the next frame is searched in full."""
        self._tracks.clear()
        self._fits.clear()
        self._last_full = self._last_thorough = -np.inf

    def track(
        self,
        gray: NDArray[np.uint8],
        stamp: float,
        expect: Expect | None = None,
        search_later: bool = False,
    ) -> list[Tag]:
        """Find the tags of one frame.

        Args:
            gray: image (rows, columns) of uint8.
            stamp: when it was taken [s]; must grow from call to call, or tracking starts anew.
            expect: says where tags are that were not found, None if nothing is known of that.
            search_later: leave a search of the whole image that can add nothing to this answer to
                `search_again`, for those who wait for the answer.

        Returns:
            Tags of the map, each id once.
        """
        image = self._detector.seen(gray)
        self.counts.frames += 1
        self._postponed = None
        if any(
            track.stamp >= stamp or track.stamp < stamp - 1.0 for track in self._tracks.values()
        ):
            self.reset()
        predicted = {tag: track.predict(stamp) for tag, track in self._tracks.items()}
        found = self._by_prediction(image, predicted)
        if expect is None:
            self._by_pattern(image, predicted, found)
        self.counts.tracked += len(found)
        self._by_expectation(image, stamp, found, expect)
        known = len(found)
        self._search_in_full(image, stamp, found, predicted, search_later)
        if lost := [tag for tag in predicted if tag not in found]:
            self._merge(found, self._by_regions(image, lost, predicted), predicted)
        if len(found) > known:
            self._by_expectation(image, stamp, found, expect)
        self._remember_looks(image, found)
        self._remember(found, stamp)
        return [found[tag] for tag in sorted(found)]

    def search_again(self, gray: NDArray[np.uint8]) -> None:
        """Search the whole of the last image for duplicates and unknown tags, if that was left."""
        if self._postponed is not None:
            self.counts.full_searches += 1
            self._merge(self._postponed, self._detector.detect(gray, enough=()), {})
            self._postponed = None

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
        if not looked_for - found.keys():
            return
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
        search_later: bool,
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
        if search_later and not missing and not absent:
            self._postponed = found
            return
        if thorough:
            self._last_thorough = stamp
        self.counts.full_searches += 1
        enough = self._wanted - found.keys()
        tags = self._detector.search(image, "full", 1, thorough, enough)
        self._merge(found, tags, predicted)

    def _by_prediction(
        self, image: NDArray[np.uint8], predicted: dict[int, NDArray[np.float64]]
    ) -> dict[int, Tag]:
        """Find tags where they were seen last or where they go from there."""
        fresh = [tag for tag, track in self._tracks.items() if track.missed == 0]
        found = self._unmoved(image, fresh)
        cells = self._detector.family.border_cells
        for tag in fresh:
            track = self._tracks[tag]
            if tag in found or not track.foreseen(cells):
                continue
            seen = self._detector.confirm_at_once(image, predicted[tag], track.tag)
            if seen is None:
                track.avoid_pattern()
            else:
                found[tag] = seen
        if rest := [tag for tag in fresh if tag not in found]:
            quads = np.ascontiguousarray([predicted[tag] for tag in rest])
            last = {tag: self._tracks[tag].tag for tag in rest}
            before = {tag: (seen.blur, np.array(seen.smear)) for tag, seen in last.items()}
            ids = np.array(rest, dtype=np.int64)
            search = self.options.search
            tags = self._detector.confirm(image, ids, quads, search, "tracked", before)
            found.update({tag.id: tag for tag in tags})
        return found

    def _unmoved(self, image: NDArray[np.uint8], fresh: Sequence[int]) -> dict[int, Tag]:
        """Return the tags that do not move and look as they did; the one longest not fitted is not.

        Their corners are those of the picture in which they were fitted last.
        """
        settled = [tag for tag in fresh if self._fits.get(tag, 0) >= self.options.still_after]
        if settled:
            settled.remove(min(settled, key=lambda tag: self._looks[tag][0]))
        if not settled:
            return {}
        tags = [self._tracks[tag].tag for tag in settled]
        looks = self._look(image, tags)
        before = np.array([self._looks[tag][1] for tag in settled])
        return {
            tag.id: tag if tag.found_by == "still" else replace(tag, found_by="still")
            for tag, same in zip(tags, unmoved(looks, before), strict=True)
            if same
        }

    def _look(self, image: NDArray[np.uint8], tags: Sequence[Tag]) -> NDArray[np.float64]:
        looks = np.empty((len(tags), 4, 2))
        corners = np.array([tag.corners for tag in tags])
        look_at_borders(image, corners, self._detector.family.border_cells, looks)
        return looks

    def _remember_looks(self, image: NDArray[np.uint8], found: dict[int, Tag]) -> None:
        """Note how tags look that do not move and were fitted in this picture."""
        fitted = [tag for tag in found.values() if tag.id in self._still and tag.measured]
        if not fitted:
            return
        for tag, look in zip(fitted, self._look(image, fitted), strict=True):
            track = self._tracks.get(tag.id)
            rests = track is not None and np.abs(tag.corners - track.tag.corners).max() < _MOVED
            self._fits[tag.id] = self._fits.get(tag.id, 0) + 1 if rests else 0
            self._looks[tag.id] = (self.counts.frames, look)

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
        mosaic, corners = mosaic_of(image, boxes)
        found: list[Tag] = []
        for scale in (1, 2):
            searched = mosaic if scale == 1 else sharpened(mosaic, scale)
            seen = self._detector.search(searched, "region", scale)
            if not seen:
                continue
            # Back to the whole image, where the corners are refined in pixels as they came.
            quads = (np.array([tag.corners for tag in seen]) + 0.5) / scale - 0.5
            quads = from_mosaic(quads, boxes, corners)
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
            if track is None:
                self._tracks[tag_id] = Track(tag, stamp)
            elif self._fits.get(tag_id, 0) > 0:
                self._tracks[tag_id] = track.rest(tag, stamp)
            else:
                self._tracks[tag_id] = track.follow(tag, stamp)
        for tag_id in [tag for tag in self._tracks if tag not in found]:
            track = self._tracks[tag_id]
            track.missed += 1
            if track.missed > self.options.keep_frames:
                del self._tracks[tag_id]
                self._fits.pop(tag_id, None)


def _distinct(tags: Sequence[Tag]) -> list[Tag]:
    """Drop candidates that are the same tag found twice."""
    kept: list[Tag] = []
    for tag in tags:
        if all(np.hypot(*(tag.centre - other.centre)) > 0.5 * tag.pixel_size for other in kept):
            kept.append(tag)
    return kept
