"""What a calibration run leaves: pressures and shapes on one time axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LogError(ValueError):
    """A log cannot be used; the message names what is missing and the remedy."""


@dataclass(frozen=True)
class CalibrationLog:
    """One run on one time axis. Missing numbers are NaN.

    Attributes:
        time: (K,) rising [s].
        commanded_differential: (K, M) [Pa].
        measured_differential: (K, M) [Pa].
        bend_angles: (K, M) [rad], as the tracker measures them.
        tip: (K, 2) [m]; all NaN where a log has no scale.
        source: where it came from, for provenance.
    """

    time: Array
    commanded_differential: Array
    measured_differential: Array
    bend_angles: Array
    tip: Array
    source: str = ""

    def __post_init__(self) -> None:
        rows = self.time.shape
        if self.time.ndim != 1 or self.time.size < 2:
            raise LogError(f"a log needs two instants or more, time has shape {rows}")
        if not np.all(np.diff(self.time) > 0):
            raise LogError("the time of a log must rise from row to row")
        inputs = self.commanded_differential.shape
        for name in ("commanded_differential", "measured_differential", "bend_angles"):
            if getattr(self, name).shape != inputs:
                raise LogError(f"{name} has shape {getattr(self, name).shape}, expected {inputs}")
        if len(inputs) != 2 or inputs[0] != rows[0] or self.tip.shape != (rows[0], 2):
            raise LogError(f"pressures {inputs} and tip {self.tip.shape} do not fit time {rows}")

    @property
    def segment_count(self) -> int:
        """M."""
        return int(self.bend_angles.shape[1])
