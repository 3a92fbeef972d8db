"""Where the limb is clamped, found from the limb itself, beside where a map says that it is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.pose.shape import (
    LimbGeometry,
    PlanarTag,
    ShapeFitter,
    ShapePrior,
    centreline_pose,
)

_FREE = ShapePrior(base_position=0.05, base_heading=0.5, corrections=(2.0,))
"""The clamp may be anywhere near; the limb bends nearly as arcs."""
_NOISE = np.diag([1e-4, 1e-4, 3e-3]) ** 2
_MOST = 60
"""Frames that are looked at."""


class Clamp(NamedTuple):
    """Where the limb begins in `limb_base`, where all should be zero.

    Attributes:
        place: (3,) x, y [m] and heading [rad].
        sigma: (3,) standard deviations, from how much frames differ.
    """

    place: NDArray[np.float64]
    sigma: NDArray[np.float64]


def find_clamp(
    geometry: LimbGeometry,
    arc_lengths: NDArray[np.float64],
    offsets: Sequence[tuple[float, float, float]],
    places: NDArray[np.float64],
) -> Clamp | None:
    """Find where a limb is clamped from frames in which it bends to all sides.

    Args:
        geometry: of the limb.
        arc_lengths: (n,) of its tags or bodies [m].
        offsets: n mounting offsets: along and across the limb [m], direction [rad].
        places: (K, n, 3) x, y [m], heading [rad] of them; NaN where not seen.

    Returns:
        The clamp; None if fewer than three frames show three of them.
    """
    fitter = ShapeFitter(geometry, _FREE, reject_beyond=1.0)
    seen = np.asarray(np.isfinite(places).all(axis=2))
    frames = np.flatnonzero(seen.sum(axis=1) >= 3)
    found = []
    for k in frames[np.linspace(0, len(frames) - 1, min(_MOST, len(frames))).astype(int)]:
        tags = []
        for i in np.flatnonzero(seen[k]).tolist():
            pose = centreline_pose(places[k, i], offsets[i])
            tags.append(PlanarTag(i, float(arc_lengths[i]), pose, _NOISE))
        estimate = fitter.fit(tags)
        if estimate is not None:
            steps = np.diff(estimate.curve[:3], axis=0)
            first, second = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
            # Each chord has the heading of its middle.
            found.append([*estimate.curve[0], first - 0.5 * (second - first)])
    if len(found) < 3:
        return None
    table = np.array(found)
    # Frames of one run are alike: what they differ by does not average out.
    return Clamp(np.median(table, axis=0), table.std(axis=0))
