"""What drawing needs: the limb that draws, what it reaches, previews, and kept drawings."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.page.commands import Load
from der_planner.page.drawing.kept import MOST_POINTS, DrawingError, Drawings
from der_planner.page.drawing.preview import Previewer
from der_planner.page.drawing.region import reachable_region
from der_planner.planning import PathLimits

Array = NDArray[np.float64]

REGIONS_KEPT = 8
"""Loads whose reachable regions are remembered."""


class Studio:
    """Everything of drawing that all windows share.

    Args:
        limb: that draws, mounted as the planner's.
        limits: of the tip, as the planner has them.
        folder: of kept drawings.
        carried: the planner's payload, and where.
    """

    def __init__(
        self, limb: Limb, limits: PathLimits, folder: Path, carried: Load | None = None
    ) -> None:
        self.limb = limb
        self.previewer = Previewer(limits)
        self.drawings = Drawings(folder)
        self._carried = carried or Load()
        self.region = lru_cache(REGIONS_KEPT)(self._region)
        self.limb_under(self._carried)  # what it cannot carry is refused at once

    def limb_under(self, load: Load) -> Limb:
        """Return the limb as the planner would have it for a command of this load.

        Raises:
            LimbError: no such mounting, or no such place on the limb.
        """
        limb = self.limb.mounted(load.mounting) if load.mounting else self.limb
        carried = load if load.payload else self._carried
        return limb.carrying(carried.payload, carried.payload_at or None)

    def _region(self, load: Load) -> list[Array]:
        """Return outlines (P, 2) [m] of what the tip reaches; takes about a second at first.

        Raises:
            LimbError: as `limb_under`.
        """
        return reachable_region(self.limb_under(load))


def drawn_pixels(sent: Any) -> Array:
    """Return what a browser says it has drawn as points (P, 2) [px].

    Raises:
        DrawingError: it is no list of two or more pairs of finite numbers.
    """
    try:
        points = np.array(sent, dtype=float)
    except (TypeError, ValueError) as error:
        raise DrawingError("a drawing must be a list of points") from error
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise DrawingError("draw a line: a drawing needs two points or more")
    if len(points) > MOST_POINTS:
        raise DrawingError(f"a drawing may have {MOST_POINTS} points: draw less at once")
    if not np.all(np.isfinite(points)):
        raise DrawingError("a point of the drawing is not finite")
    return points
