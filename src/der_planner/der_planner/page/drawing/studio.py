"""What drawing needs: the limb that draws, what it reaches, previews, and kept drawings."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.page.drawing.kept import MOST_POINTS, DrawingError, Drawings
from der_planner.page.drawing.preview import Previewer
from der_planner.page.drawing.region import reachable_region
from der_planner.planning import PathLimits

Array = NDArray[np.float64]


class Studio:
    """Everything of drawing that all windows share.

    Args:
        limb: that draws, under its loads.
        limits: of the tip, as the planner has them.
        folder: of kept drawings.
    """

    def __init__(self, limb: Limb, limits: PathLimits, folder: Path) -> None:
        self.limb = limb
        self.previewer = Previewer(limb, limits)
        self.drawings = Drawings(folder)

    @cached_property
    def region(self) -> list[Array]:
        """Outlines (P, 2) [m] of what the tip reaches; takes about a second at first."""
        return reachable_region(self.limb)


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
