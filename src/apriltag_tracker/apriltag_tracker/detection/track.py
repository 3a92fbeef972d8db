"""What is known of one tag from picture to picture: where it goes, and how sure that is."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.detection.tag import Tag

_FORESEEN = 0.35
"""A pattern can be fitted from a prediction that is off by less than so many cells."""

_LINES_FIRST = 10
"""Pictures in which lines are fitted first after a pattern that did not fit from a prediction."""


def _nowhere() -> NDArray[np.float64]:
    return np.zeros((4, 2))


@dataclass
class Track:
    """One tag as it was seen last, and how it goes on.

    Attributes:
        tag: as seen last.
        stamp: of that picture [s].
        velocity: (4, 2) px/s of the corners, since the picture before.
        acceleration: (4, 2) px/s², zero before it is known.
        curved: whether the acceleration counts; not where the last picture was nearer without it.
        step: s from the picture before to the last one, 0 if there is none.
        surprise: how far the corners were from where they were foreseen [px].
        missed: pictures since then in which the tag was not found.
        lines_first: pictures to come in which the pattern is not tried from the prediction.
    """

    tag: Tag
    stamp: float
    velocity: NDArray[np.float64] = field(default_factory=_nowhere)
    acceleration: NDArray[np.float64] = field(default_factory=_nowhere)
    curved: bool = True
    step: float = 0.0
    surprise: float = math.inf
    missed: int = 0
    lines_first: int = 0

    def predict(self, stamp: float) -> NDArray[np.float64]:
        """Return the corners (4, 2) px at a time [s]: the parabola through the last pictures."""
        gap = stamp - self.stamp
        corners = self.tag.corners + self.velocity * gap
        return corners + self._bent(gap) if self.curved else corners

    def _bent(self, gap: float) -> NDArray[np.float64]:
        """Return by how much the parabola leaves the straight line after a time [s], (4, 2) px."""
        bent: NDArray[np.float64] = self.acceleration * (0.5 * gap * (gap + self.step))
        return bent

    def foreseen(self, cells: int) -> bool:
        """Tell whether the pattern, of so many cells along the border, can be fitted at once."""
        near = self.surprise < _FORESEEN * self.tag.pixel_size / cells
        return near and self.missed == 0 and self.lines_first == 0

    def avoid_pattern(self) -> None:
        """Fit lines first for some pictures: the pattern did not fit from the prediction."""
        self.lines_first = _LINES_FIRST

    def follow(self, tag: Tag, stamp: float) -> Track:
        """Return the track with one more picture of the tag."""
        step = stamp - self.stamp
        if step <= 0.0:
            return Track(tag, stamp)
        moved = tag.corners - self.tag.corners
        velocity = moved / step
        off = moved - self.velocity * step
        straight, bent = (float(np.abs(gap).max()) for gap in (off, off - self._bent(step)))
        acceleration = _nowhere()
        if self.step > 0.0 and self.missed == 0:
            acceleration = (velocity - self.velocity) * (2.0 / (step + self.step))
        return Track(
            tag,
            stamp,
            velocity,
            acceleration,
            bent <= straight,
            step,
            min(straight, bent),
            lines_first=max(self.lines_first - 1, 0),
        )

    def rest(self, tag: Tag, stamp: float) -> Track:
        """Return the track with one more picture of a tag that stands still."""
        gone = float(np.abs(tag.corners - self.tag.corners).max())
        return Track(tag, stamp, surprise=gone, lines_first=max(self.lines_first - 1, 0))
