"""The weight of a limb whose segments bend evenly, as the bend at rest takes it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.model.resting import Weight

Array = NDArray[np.float64]

PIECES = 4
"""Straight pieces a segment."""


def weight_of(limb: Limb) -> Weight:
    """Return the weight in the plane of segments, connectors and carried masses.

    A limb that no gravity pulls in its plane has no pieces.
    """
    gravity = np.array(limb.gravity[:2], dtype=float)
    count = limb.segment_count
    if not gravity.any():
        return Weight(np.zeros(0), np.zeros((0, count)), gravity)
    lengths, masses, turning = [], [], []
    for index, segment in enumerate(limb.segments):
        if index and limb.connector_length:
            before = limb.segments[index - 1].mass_per_length
            mean = 0.5 * (before + segment.mass_per_length)
            lengths.append(limb.connector_length)
            masses.append(mean * limb.connector_length)
            turning.append((np.arange(count) < index).astype(float))
        for piece in range(PIECES):
            lengths.append(segment.length / PIECES)
            masses.append(segment.mass_per_length * segment.length / PIECES)
            share = (np.arange(count) < index).astype(float)
            share[index] = (piece + 0.5) / PIECES
            turning.append(share)
    length, mass = np.array(lengths), np.array(masses)
    ends = limb.base_length + np.cumsum(length)
    first = 0.5 * mass * length
    for item in limb.masses:
        if item.arc_length <= limb.base_length:
            continue
        piece = min(int(np.searchsorted(ends, item.arc_length)), len(ends) - 1)
        mass[piece] += item.mass
        first[piece] += item.mass * (item.arc_length - ends[piece] + length[piece])
    beyond = np.append(np.cumsum(mass[::-1])[::-1][1:], 0.0)
    return Weight(first + length * beyond, np.array(turning), gravity)


def torques(limb: Limb, bend: Array) -> Array:
    """Return the torques (K, M) of the weight on the bend angles (K, M) [N·m]."""
    weight = weight_of(limb)
    heading = bend @ weight.turning.T
    x, y = weight.gravity
    turns = weight.lever * (y * np.cos(heading) - x * np.sin(heading))
    torque: Array = turns @ weight.turning
    return torque
