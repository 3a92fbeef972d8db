"""What the sensors read when the chambers are open: measured, and doubted."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pressure_driver.watch.limits import MonitorLimits

PLAUSIBLE_ATMOSPHERE = (70_000.0, 105_000.0)
"""[Pa] at 3000 m, and above what the barometer reads at sea level but for a few days in a century:
chambers that rest higher hold trapped air, unless the parameter 'atmosphere' says otherwise."""
LARGEST_OFFSET = 1_000.0
"""[Pa] that the sensors of one board may differ by at rest, and that a chamber may rest higher than
it did before."""
NOT_STEADY = "chambers must be vented and steady"


class RestPressures:
    """Averages readings of vented chambers.

    They must be steady (also in the mean, so that air which leaves slowly is not taken for rest),
    plausible for a room, about the same in all chambers, and not higher than the rest that was
    measured before.

    Args:
        chamber_count: 2M.
        limits: of normal operation.
        atmosphere: [Pa] absolute if it is known; 0 to measure it.
    """

    def __init__(self, chamber_count: int, limits: MonitorLimits, atmosphere: float = 0.0) -> None:
        self.pressure = np.full(chamber_count, atmosphere or np.nan)
        """(2M,) [Pa] absolute, what each sensor reads when vented; NaN until measured."""
        self.mean = float(np.mean(self.pressure))
        """[Pa] of them, which every tick asks for; NaN until they are all known."""
        self._limits = limits
        self._given = bool(atmosphere)
        self._window: list[tuple[float, NDArray[np.float64]]] = []
        self._problem = NOT_STEADY
        self._lowest = np.full(chamber_count, np.inf)

    @property
    def known(self) -> bool:
        """Whether every chamber's rest pressure has been measured or given."""
        return math.isfinite(self.mean)

    @property
    def problem(self) -> str:
        """Why the rest pressures are not known; nothing if they are."""
        if self.known:
            return ""
        return f"the rest pressures are not measured yet: {self._problem}"

    def forget_readings(self) -> None:
        """Begin the next measurement afresh."""
        self._window.clear()

    def receive(self, reading: NDArray[np.float64], now: float) -> None:
        """Take a reading (2M,) [Pa] of chambers that have been commanded to vent."""
        if self._given:
            return
        window = self._window
        window.append((now, reading))
        while window and now - window[0][0] > self._limits.rest_time * 1.5:
            window.pop(0)
        readings = np.array([each for _, each in window])
        self._problem = self._unfit(readings)
        if self._problem:
            window.clear()
            return
        if now - window[0][0] < self._limits.rest_time:
            self._problem = NOT_STEADY
            return
        half = len(readings) // 2
        drift = np.abs(readings[half:].mean(axis=0) - readings[:half].mean(axis=0))
        if np.max(drift) > self._limits.rest_drift:
            self._problem = NOT_STEADY
            return
        self.pressure = readings.mean(axis=0)
        self.mean = float(np.mean(self.pressure))
        self._lowest = np.minimum(self._lowest, self.pressure)

    def _unfit(self, readings: NDArray[np.float64]) -> str:
        """Return why readings (K, 2M) [Pa] cannot be rest pressures, or nothing."""
        newest = readings[-1]
        low, high = PLAUSIBLE_ATMOSPHERE
        if np.min(newest) < low or np.max(newest) > high:
            return (
                f"chambers read {np.min(newest):.0f} to {np.max(newest):.0f} Pa, no room has that "
                f"({low:.0f} to {high:.0f} Pa): let trapped air out, or set the parameter "
                "'atmosphere' to what a barometer reads"
            )
        if np.ptp(newest) > LARGEST_OFFSET:
            return (
                f"chambers read {np.min(newest):.0f} to {np.max(newest):.0f} Pa: vented they agree "
                f"within {LARGEST_OFFSET:.0f} Pa"
            )
        if np.max(np.ptp(readings, axis=0)) > self._limits.rest_spread:
            return NOT_STEADY
        if np.max(newest - self._lowest) > LARGEST_OFFSET:
            return (
                f"chambers rest {np.max(newest - self._lowest):.0f} Pa higher than before: "
                "let trapped air out, or start the driver again"
            )
        return ""
