"""What of a limb changes from one day to another, and by how much."""

from __future__ import annotations

import math
from dataclasses import replace

from der_planner.limb.parameters import Segment

GAIN_SPREAD = 0.35
"""From one day to another, of the logarithm of a gain: a real limb's changed by up to a half."""
REST_SPREAD = math.radians(6.0)
"""Of a rest angle: those of a real limb wander by so much [rad]."""
LARGEST_GAIN_CHANGE = 4.0
"""Largest factor by which a fit may change a gain."""
LARGEST_REST_CHANGE = math.radians(35.0)
"""Largest change of a rest angle in a fit [rad]."""
LARGEST_CHANGES = (
    math.log(LARGEST_GAIN_CHANGE) / GAIN_SPREAD,
    LARGEST_REST_CHANGE / REST_SPREAD,
)
"""Both limits as multiples of the spreads."""


def on_another_day(segment: Segment, gain: float, rest: float) -> Segment:
    """Return a segment with another gain and rest angle.

    Args:
        segment: to begin with.
        gain: change of the gain's logarithm, in `GAIN_SPREAD`.
        rest: change of the rest angle, in `REST_SPREAD`.
    """
    return replace(
        segment,
        moment_gain=segment.moment_gain * math.exp(GAIN_SPREAD * gain),
        rest_curvature=float(segment.rest_curvature + REST_SPREAD * rest / segment.length),
    )
