"""Watches what the board measures: is it alive, within limits, and does it follow its commands?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pressure_driver.protocols.base import Telemetry


@dataclass(frozen=True)
class MonitorLimits:
    """Bounds of normal operation."""

    telemetry_timeout: float = 0.5
    """[s] without chamber pressures."""
    over_pressure: float = 30_000.0
    """[Pa] gauge, in any chamber."""
    supply_low: float = 115_000.0
    """[Pa] absolute."""
    supply_high: float = 200_000.0
    """[Pa] absolute."""
    supply_time: float = 0.5
    """[s] that the supply may be outside its bounds."""
    follow_tolerance: float = 3_000.0
    """[Pa] beyond the slowest and fastest response that counts as normal."""
    follow_time: float = 2.0
    """[s] that a chamber may be outside."""
    slowest_fill: float = 4_000.0
    """[Pa/s] that a working valve reaches."""
    slowest_vent: float = 2.5
    """[s] time constant in which a working valve vents."""
    rest_time: float = 0.5
    """[s] of steady readings that make a rest measurement."""
    rest_spread: float = 100.0
    """[Pa] that readings at rest may differ by."""
    vented_tolerance: float = 500.0
    """[Pa] gauge below which a chamber counts as vented."""


PLAUSIBLE_ATMOSPHERE = (70_000.0, 110_000.0)
"""[Pa] at 3000 m and in the deepest low-lying high; a reading outside is no atmosphere."""
LARGEST_OFFSET = 1_000.0
"""[Pa] that the sensors of one board may differ by at rest."""
SAMPLES_TO_TRIP = 2
"""Readings in a row: one damaged line of a protocol without checksum must not vent a limb."""


class Monitor:
    """Keeps the newest telemetry and says what is wrong with it.

    Args:
        chamber_count: 2M.
        limits: of normal operation.
        atmosphere: [Pa] absolute if it is known; 0 to measure it from chambers at rest.
    """

    def __init__(self, chamber_count: int, limits: MonitorLimits, atmosphere: float = 0.0) -> None:
        self.limits = limits
        self.chamber_count = chamber_count
        unknown = np.full(chamber_count, np.nan)
        self.chamber_pressure = unknown.copy()
        """(2M,) [Pa] absolute, as measured."""
        self.valve_opening = unknown.copy()
        self.supply_pressure = float("nan")
        self.rest_pressure = np.full(chamber_count, atmosphere) if atmosphere else unknown.copy()
        """(2M,) [Pa] absolute, what each sensor reads when vented; NaN until measured."""
        self._fixed_atmosphere = bool(atmosphere)
        self._last_telemetry: float | None = None
        self._over_count = 0
        self._supply_bad_since: float | None = None
        self._outside_since: list[float | None] = [None] * chamber_count
        self._upper = np.zeros(chamber_count)
        self._lower = np.zeros(chamber_count)
        self._command = np.zeros(chamber_count)
        self._envelope_time: float | None = None
        self._rest_window: list[tuple[float, NDArray[np.float64]]] = []

    @property
    def atmosphere(self) -> float:
        """[Pa] mean of the rest pressures; NaN until measured."""
        return float(np.mean(self.rest_pressure))

    @property
    def gauge(self) -> NDArray[np.float64]:
        """(2M,) [Pa] measured pressures above those at rest."""
        gauge: NDArray[np.float64] = self.chamber_pressure - self.rest_pressure
        return gauge

    def telemetry_age(self, now: float) -> float:
        """Return the age [s] of the newest chamber pressures; NaN before the first."""
        return float("nan") if self._last_telemetry is None else now - self._last_telemetry

    def rest_known(self) -> bool:
        """Tell whether every chamber's rest pressure has been measured or given."""
        return bool(np.all(np.isfinite(self.rest_pressure)))

    def describe_gauge(self) -> str:
        """Return the gauge pressures as text, in kPa."""
        return "gauge " + ", ".join(f"{value / 1000.0:.2f}" for value in self.gauge) + " kPa"

    def vented(self) -> bool:
        """Tell whether every chamber reads about its rest pressure."""
        gauge = self.gauge
        return bool(np.all(np.abs(gauge) <= self.limits.vented_tolerance))

    def receive(self, telemetry: Telemetry, now: float, resting: bool) -> None:
        """Take one telemetry message.

        Args:
            telemetry: decoded.
            now: [s] steady clock.
            resting: the chambers have been commanded to vent, so rest pressures may be measured.
        """
        if telemetry.supply_pressure is not None:
            self.supply_pressure = telemetry.supply_pressure
            low, high = self.limits.supply_low, self.limits.supply_high
            if low <= self.supply_pressure <= high:
                self._supply_bad_since = None
            elif self._supply_bad_since is None:
                self._supply_bad_since = now
        if telemetry.valve_opening is not None:
            self.valve_opening = np.asarray(telemetry.valve_opening)
        if telemetry.chamber_pressure is None:
            return
        self.chamber_pressure = np.asarray(telemetry.chamber_pressure)
        if self._last_telemetry is None:
            self.reset_following(now)
        self._last_telemetry = now
        reference = np.where(np.isnan(self.rest_pressure), 101_325.0, self.rest_pressure)
        over = np.max(self.chamber_pressure - reference) > self.limits.over_pressure
        self._over_count = self._over_count + 1 if over else 0
        if resting and not self._fixed_atmosphere:
            self._measure_rest(now)
        else:
            self._rest_window.clear()
        self._check_following(now)

    def _measure_rest(self, now: float) -> None:
        """Average steady, plausible and mutually agreeing readings into the rest pressures."""
        window = self._rest_window
        window.append((now, self.chamber_pressure))
        while window and now - window[0][0] > self.limits.rest_time * 1.5:
            window.pop(0)
        readings = np.array([reading for _, reading in window])
        low, high = PLAUSIBLE_ATMOSPHERE
        plausible = bool(np.all((readings > low) & (readings < high)))
        agreeing = bool(np.ptp(readings[-1]) <= LARGEST_OFFSET)
        steady = bool(np.all(np.ptp(readings, axis=0) <= self.limits.rest_spread))
        if not (plausible and agreeing and steady):
            window.clear()
        elif now - window[0][0] >= self.limits.rest_time:
            self.rest_pressure = readings.mean(axis=0)

    def command(self, differential: Sequence[float], now: float) -> None:
        """Tell what has just been commanded, for the following check.

        Args:
            differential: (M,) [Pa].
            now: [s] steady clock.
        """
        self._move_envelope(now)
        self._command = chamber_gauge(differential)
        self._upper = np.maximum(self._upper, self._command)
        self._lower = np.minimum(self._lower, self._command)

    def _move_envelope(self, now: float) -> None:
        """Let the slowest admissible response approach the command."""
        if self._envelope_time is not None:
            dt = max(now - self._envelope_time, 0.0)
            decay = np.exp(-dt / self.limits.slowest_vent)
            self._upper = self._command + (self._upper - self._command) * decay
            rising = np.minimum(self._lower + dt * self.limits.slowest_fill, self._command)
            self._lower = np.where(self._lower < self._command, rising, self._command)
        self._envelope_time = now

    def _check_following(self, now: float) -> None:
        self._move_envelope(now)
        gauge = self.gauge
        tolerance = self.limits.follow_tolerance
        outside = (gauge > self._upper + tolerance) | (gauge < self._lower - tolerance)
        for chamber, bad in enumerate(outside):
            if not bad:
                self._outside_since[chamber] = None
            elif self._outside_since[chamber] is None:
                self._outside_since[chamber] = now

    def reset_following(self, now: float) -> None:
        """Start the following check afresh from what is measured now."""
        gauge = np.nan_to_num(self.gauge)
        self._upper = np.maximum(gauge, self._command)
        self._lower = np.minimum(gauge, self._command)
        self._envelope_time = now
        self._outside_since = [None] * self.chamber_count

    def forget(self) -> None:
        """Forget the newest telemetry, as after a disconnect."""
        self._last_telemetry = None
        self._over_count = 0
        self._supply_bad_since = None
        self._rest_window.clear()
        self.chamber_pressure = np.full(self.chamber_count, np.nan)
        self.valve_opening = np.full(self.chamber_count, np.nan)
        self.supply_pressure = float("nan")

    def telemetry_faults(self, now: float) -> list[str]:
        """Say whether the board has gone silent."""
        age = self.telemetry_age(now)
        if self._last_telemetry is None:
            return ["no telemetry from the board yet"]
        if age > self.limits.telemetry_timeout:
            return [f"no telemetry for {age:.1f} s"]
        return []

    def overpressure_faults(self) -> list[str]:
        """Say whether a chamber is over-pressurised."""
        if self._over_count < SAMPLES_TO_TRIP:
            return []
        worst = int(np.nanargmax(self.chamber_pressure))
        return [
            f"over-pressure: chamber {worst} reads {self.chamber_pressure[worst]:.0f} Pa, "
            f"the limit is {self.limits.over_pressure:.0f} Pa above the atmosphere"
        ]

    def following_faults(self, now: float) -> list[str]:
        """Say which chambers do not follow their commands."""
        faults = []
        for chamber, since in enumerate(self._outside_since):
            if since is not None and now - since >= self.limits.follow_time:
                faults.append(
                    f"chamber {chamber} does not follow: {self.gauge[chamber]:.0f} Pa gauge, "
                    f"commanded {self._command[chamber]:.0f} Pa"
                )
        return faults

    def supply_faults(self, now: float) -> list[str]:
        """Say whether the supply has left its bounds."""
        since = self._supply_bad_since
        if since is None or now - since < self.limits.supply_time:
            return []
        side = "low" if self.supply_pressure < self.limits.supply_low else "high"
        return [
            f"supply too {side}: {self.supply_pressure:.0f} Pa, allowed "
            f"{self.limits.supply_low:.0f} to {self.limits.supply_high:.0f} Pa absolute"
        ]


def chamber_gauge(differential: Sequence[float]) -> NDArray[np.float64]:
    """Return the gauge pressures (2M,) [Pa] of pairs: one chamber vented, the other at |u|."""
    difference = np.asarray(differential, dtype=np.float64)
    return np.stack([np.maximum(difference, 0.0), np.maximum(-difference, 0.0)], axis=1).ravel()
