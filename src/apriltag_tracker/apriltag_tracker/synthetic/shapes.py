"""Shapes for tests and demonstrations: arcs of constant curvature, with an elongation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apriltag_tracker.synthetic.camera import Shape


def constant_curvature(
    lengths: Sequence[float], bends: Sequence[float], elongation: float = 1.0, points: int = 121
) -> Shape:
    """Return a limb whose segments are arcs.

    Args:
        lengths: of the segments at rest [m].
        bends: angle each of them turns by [rad].
        elongation: length over length at rest.
        points: of the whole centreline.
    """
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    arc_length = np.unique(np.concatenate([np.linspace(0.0, ends[-1], points), ends]))
    curvature = np.array(bends) / np.array(lengths)
    heading = np.zeros_like(arc_length)
    for k, bend in enumerate(curvature):
        heading += bend * np.clip(arc_length - ends[k], 0.0, lengths[k])
    return Shape(arc_length, elongation * _integrate(arc_length, heading), heading)


def _integrate(s: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Integrate unit tangents exactly for a heading that is linear between the points."""
    step, turned = np.diff(s), np.diff(heading)
    middle = 0.5 * (heading[1:] + heading[:-1])
    chord = step * np.sinc(turned / (2.0 * np.pi))
    moves = chord[:, None] * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    return np.vstack([np.zeros(2), np.cumsum(moves, axis=0)])
