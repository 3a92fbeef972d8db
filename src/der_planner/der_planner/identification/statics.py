"""Start values in closed form: gain and rest angle of each segment from a staircase."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.log import LogError

Array = NDArray[np.float64]

LEAST_EXCITATION = 1000.0
"""Standard deviation of an input below which its gain cannot be told [Pa]."""


def static_gain(pressure: Array, angle: Array) -> tuple[Array, Array]:
    """Fit angle = gain · pressure + rest for each segment.

    A planar limb without gravity bends each segment by its own couple alone, so the segments
    decouple.

    Args:
        pressure: (S, M) [Pa].
        angle: (S, M) [rad].

    Returns:
        Gains (M,) [rad/Pa] and rest angles (M,) [rad].

    Raises:
        LogError: an input was not excited.
    """
    if len(pressure) < 3:
        raise LogError(f"only {len(pressure)} resting points: run the whole staircase")
    gains, rests = np.empty(pressure.shape[1]), np.empty(pressure.shape[1])
    for index in range(pressure.shape[1]):
        if np.std(pressure[:, index]) < LEAST_EXCITATION:
            raise LogError(
                f"input {index} was not excited (standard deviation "
                f"{np.std(pressure[:, index]):.0f} Pa): its gain cannot be told"
            )
        gains[index], rests[index] = np.polyfit(pressure[:, index], angle[:, index], 1)
    return gains, rests
