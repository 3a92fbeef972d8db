"""The pressures of a calibration run."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PERIOD = 0.05
"""Of setpoints [s]."""


@dataclass(frozen=True)
class Excitation:
    """A timed sequence of differential pressures.

    Attributes:
        time: (K,) [s].
        differential_pressure: (K, M) [Pa].
        stairs: (S, 2) first and last instant of each stair's rest [s].
    """

    time: Array
    differential_pressure: Array
    stairs: Array


def staircase(
    amplitude: float, segment_count: int = 2, levels: int = 3, hold: float = 4.0
) -> Excitation:
    """Return a slow staircase both ways on each input alone, on all together and alternating.

    Args:
        amplitude: largest |differential pressure| [Pa].
        segment_count: M.
        levels: stairs from zero to the amplitude.
        hold: duration of a stair [s].
    """
    up = np.arange(0, levels + 1) / levels
    cycle = np.concatenate([up, up[-2::-1], -up[1:], -up[-2::-1]])
    directions = [*np.eye(segment_count)]
    if segment_count > 1:
        directions += [np.ones(segment_count), (-1.0) ** np.arange(segment_count)]
    heights = amplitude * np.concatenate([np.outer(cycle, direction) for direction in directions])
    per_stair = round(hold / PERIOD)
    pressure = np.repeat(heights, per_stair, axis=0)
    time = np.arange(len(pressure)) * PERIOD
    ends = (np.arange(len(heights)) + 1) * hold
    # The end of a stair, when neither air nor limb moves any more.
    stairs = np.stack([ends - 0.2 * hold, ends - 0.5 * PERIOD], axis=1)
    return Excitation(time, pressure, stairs)
