"""How well the tracker sees: scenes, and a limb that swings before the synthetic camera."""

from __future__ import annotations

import numpy as np

from apriltag_tracker.synthetic.shapes import Shape, constant_curvature
from apriltag_tracker.tag_map import TagMap


class Swing:
    """A limb that swings, each segment at its own period."""

    def __init__(self, tags: TagMap) -> None:
        self._lengths = tags.segment_lengths

    def shape(self, time: float) -> Shape:
        """Return the shape at a time [s]."""
        bends = 0.8 * np.sin(2.0 * np.pi * time / np.array([3.0, 4.0]))
        return constant_curvature(self._lengths, bends.tolist())

    def velocity(self, time: float) -> Shape:
        """Return what the shape changes by in a second, as a shape."""
        before, after = self.shape(time - 1e-3), self.shape(time + 1e-3)
        points, heading = after.points - before.points, after.heading - before.heading
        return Shape(before.arc_length, points / 2e-3, heading / 2e-3)
