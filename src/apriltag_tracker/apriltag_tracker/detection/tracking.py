"""Tags from frame to frame: short searches where tags are expected, full searches for lost ones.

A tag that was seen is looked for where the parabola through its last three pictures foresees it:
lines are fitted to its border and its code is read there. When one is missing, the whole image is
searched at once, and later ten times a second.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection.detector import Detector, Tag

_ABSENT_PERIOD = 0.1
"""While a tag has been missing for long, the whole image is searched this often [s]."""

_KEPT_FRAMES = 8
"""A tag that is missing for more frames than this is missing for long."""

_LONGEST_GAP = 1.0
"""After a longer time without images tracking starts anew [s]."""


@dataclass
class TrackingCounts:
    """How often what happened since the start."""

    full_searches: int = 0
    duplicates: int = 0
    unknown: dict[int, int] = field(default_factory=dict)


def _zero() -> NDArray[np.float64]:
    return np.zeros((4, 2))


@dataclass
class Track:
    """One tag as it was seen last, and how it goes on.

    Attributes:
        tag: as seen last.
        stamp: of that picture [s].
        velocity: (4, 2) px/s of the corners, since the picture before.
        acceleration: (4, 2) px/s², zero before it is known.
        step: s from the picture before to the last one, 0 if there is none.
        missed: pictures since then in which the tag was not found.
    """

    tag: Tag
    stamp: float
    velocity: NDArray[np.float64] = field(default_factory=_zero)
    acceleration: NDArray[np.float64] = field(default_factory=_zero)
    step: float = 0.0
    missed: int = 0

    def predict(self, stamp: float) -> NDArray[np.float64]:
        """Return the corners (4, 2) px at a time [s]: the parabola through the last pictures."""
        gap = stamp - self.stamp
        bent = self.acceleration * (0.5 * gap * (gap + self.step))
        return self.tag.corners + self.velocity * gap + bent

    def follow(self, tag: Tag, stamp: float) -> Track:
        """Return the track with one more picture of the tag."""
        step = stamp - self.stamp
        velocity = (tag.corners - self.tag.corners) / step
        acceleration = _zero()
        if self.step > 0.0 and self.missed == 0:
            acceleration = (velocity - self.velocity) * (2.0 / (step + self.step))
        return Track(tag, stamp, velocity, acceleration, step)


class TagTracker:
    """Finds the tags of each frame of a sequence.

    Args:
        wanted: ids of the tags in the map; others are counted and left out.
        detector: finds and confirms tags.
    """

    def __init__(self, wanted: Collection[int], detector: Detector) -> None:
        self._wanted = frozenset(wanted)
        self._detector = detector
        self.counts = TrackingCounts()
        self._tracks: dict[int, Track] = {}
        self._last_thorough = -np.inf

    def track(self, gray: NDArray[np.uint8], stamp: float) -> list[Tag]:
        """Find the tags of one frame.

        Args:
            gray: image (rows, columns) of uint8.
            stamp: when it was taken [s]; must grow from call to call, or tracking starts anew.

        Returns:
            Tags of the map, each id once.
        """
        if any(not 0.0 < stamp - track.stamp <= _LONGEST_GAP for track in self._tracks.values()):
            self._tracks.clear()
            self._last_thorough = -np.inf
        fresh = [tag for tag, track in self._tracks.items() if track.missed == 0]
        found: dict[int, Tag] = {}
        if fresh:
            corners = np.array([self._tracks[tag].predict(stamp) for tag in fresh])
            found = {tag.id: tag for tag in self._detector.confirm(gray, fresh, corners)}
        self._search_in_full(gray, stamp, found)
        self._remember(found, stamp)
        return [found[tag] for tag in sorted(found)]

    def _search_in_full(self, gray: NDArray[np.uint8], stamp: float, found: dict[int, Tag]) -> None:
        """Add tags of the whole image, but for those that are there twice, if it is time to search.

        It is for a tag that was just lost, and now and then for one that has been missing for long.
        """
        absent = self._wanted - found.keys() - self._tracks.keys()
        thorough = bool(absent) and stamp - self._last_thorough >= _ABSENT_PERIOD
        if not thorough and self._tracks.keys() <= found.keys():
            return
        if thorough:
            self._last_thorough = stamp
        self.counts.full_searches += 1
        by_id: dict[int, list[Tag]] = {}
        for tag in self._detector.detect(gray, thorough):
            if tag.id in self._wanted:
                by_id.setdefault(tag.id, []).append(tag)
            else:
                self.counts.unknown[tag.id] = self.counts.unknown.get(tag.id, 0) + 1
        for tag_id, places in by_id.items():
            self.counts.duplicates += len(places) > 1
            if tag_id not in found and len(places) == 1:
                found[tag_id] = places[0]

    def _remember(self, found: dict[int, Tag], stamp: float) -> None:
        for tag_id, tag in found.items():
            track = self._tracks.get(tag_id)
            self._tracks[tag_id] = Track(tag, stamp) if track is None else track.follow(tag, stamp)
        for tag_id in [tag for tag in self._tracks if tag not in found]:
            track = self._tracks[tag_id]
            track.missed += 1
            if track.missed > _KEPT_FRAMES:
                del self._tracks[tag_id]
