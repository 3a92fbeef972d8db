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

    def resampled(self, period: float, longest_gap: float = 1.0) -> CalibrationLog:
        """Return the log on a regular grid, NaN in gaps longer than ``longest_gap`` [s].

        Args:
            period: of the grid [s].
            longest_gap: between two valid rows of a column that a straight line may bridge [s].
        """
        grid = np.arange(self.time[0], self.time[-1] + 1e-9, period)

        def column(values: Array) -> Array:
            known = np.isfinite(values)
            if not known.any():
                return np.full(grid.size, np.nan)
            instants = self.time[known]
            result: Array = np.interp(grid, instants, values[known])
            after = np.clip(np.searchsorted(instants, grid, side="left"), 0, len(instants) - 1)
            before = np.clip(np.searchsorted(instants, grid, side="right") - 1, 0, None)
            gap = instants[after] - instants[before]
            edge = np.minimum(np.abs(instants[after] - grid), np.abs(instants[before] - grid))
            result[(gap > longest_gap) & (edge > period)] = np.nan
            result[(grid < instants[0] - period) | (grid > instants[-1] + period)] = np.nan
            return result

        def table(values: Array) -> Array:
            return np.stack([column(part) for part in values.T], axis=1)

        return CalibrationLog(
            time=grid,
            commanded_differential=table(self.commanded_differential),
            measured_differential=table(self.measured_differential),
            bend_angles=table(self.bend_angles),
            tip=table(self.tip),
            source=self.source,
        )

    def between(self, first: float, last: float) -> CalibrationLog:
        """Return the rows from ``first`` to ``last`` [s]."""
        rows = (self.time >= first) & (self.time <= last)
        return CalibrationLog(
            time=self.time[rows],
            commanded_differential=self.commanded_differential[rows],
            measured_differential=self.measured_differential[rows],
            bend_angles=self.bend_angles[rows],
            tip=self.tip[rows],
            source=self.source,
        )
