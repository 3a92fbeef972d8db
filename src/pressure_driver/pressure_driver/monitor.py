"""Watches what the board measures: is it alive, within limits, and does it follow its commands?"""

from __future__ import annotations

from collections import deque
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
    rest_time: float = 1.0
    """[s] of steady readings that make a rest measurement."""
    rest_spread: float = 100.0
    """[Pa] that readings at rest may differ by."""
    rest_drift: float = 20.0
    """[Pa] that the two halves of a rest measurement may differ by in the mean."""
    supply_required: bool = True
    """Arm only with a fresh reading of the supply, on boards whose protocol tells it."""
    vented_tolerance: float = 500.0
    """[Pa] gauge below which a chamber counts as vented."""


PLAUSIBLE_ATMOSPHERE = (70_000.0, 105_000.0)
"""[Pa] at 3000 m, and above what the barometer reads at sea level but for a few days in a century:
chambers that rest higher hold trapped air, unless the parameter 'atmosphere' says otherwise."""
PLAUSIBLE_READING = (30_000.0, 400_000.0)
"""[Pa] A chamber that reads outside has a broken sensor or a damaged line."""
LARGEST_OFFSET = 1_000.0
"""[Pa] that the sensors of one board may differ by at rest, and that a chamber may rest higher than
it did before."""
BELOW_REST_TIME = 0.5
"""[s] that a chamber may read too little."""
BELOW_REST = 1_000.0
"""[Pa] A chamber this far below its rest pressure shows that the rest was taken under pressure."""
SAMPLES_TO_TRIP = 2
"""Readings in a row: one damaged line of a protocol without checksum must not vent a limb."""
READING_WINDOW = 2.0
"""[s] over which bad readings and damaged lines are counted."""
MOST_BAD_READINGS = 8
"""In `READING_WINDOW`: a fifth at 20 Hz."""
MOST_DAMAGED = 10
"""Damaged lines or frames in `READING_WINDOW`, if they are also `DAMAGED_SHARE` of all."""
DAMAGED_SHARE = 0.3


NOT_STEADY = "chambers must be vented and steady"


class TelemetryMonitor:
    """Keeps the newest telemetry and says what is wrong with it.

    Args:
        chamber_count: 2M.
        limits: of normal operation.
        atmosphere: [Pa] absolute if it is known; 0 to measure it from chambers at rest.
        tells_supply: the board's protocol reports the pressure of the reservoir.
    """

    def __init__(
        self,
        chamber_count: int,
        limits: MonitorLimits,
        atmosphere: float = 0.0,
        tells_supply: bool = False,
    ) -> None:
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
        self._rest_problem = NOT_STEADY
        self._lowest_rest = np.full(chamber_count, np.inf)
        self._below_since: float | None = None
        self._supply_at: float | None = None
        self._tells_supply = tells_supply
        self._bad_readings: deque[float] = deque(maxlen=MOST_BAD_READINGS)
        self._bad_chamber = 0
        self._line_quality: deque[tuple[float, int, int]] = deque()

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

    def rest_problem(self) -> str:
        """Return why the rest pressures are not known, or nothing if they are."""
        if self.rest_known():
            return ""
        return f"the rest pressures are not measured yet: {self._rest_problem}"

    @property
    def heard(self) -> bool:
        """Whether chamber pressures have come since the port was opened."""
        return self._last_telemetry is not None

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
            self._take_supply(telemetry.supply_pressure, now)
        if telemetry.valve_opening is not None:
            self.valve_opening = np.asarray(telemetry.valve_opening)
        if telemetry.chamber_pressure is None:
            return
        reading = np.asarray(telemetry.chamber_pressure, dtype=np.float64)
        low, high = PLAUSIBLE_READING
        bad = ~((reading > low) & (reading < high))  # a NaN is neither
        if bad.any():
            self._bad_readings.append(now)
            self._bad_chamber = int(np.argmax(bad))
            return
        self.chamber_pressure = reading
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
        below = self.rest_known() and bool(np.min(self.gauge) < -BELOW_REST)
        if not below:
            self._below_since = None
        elif self._below_since is None:
            self._below_since = now
        self._check_following(now)

    def _take_supply(self, pressure: float, now: float) -> None:
        self.supply_pressure, self._supply_at = pressure, now
        if self.limits.supply_low <= pressure <= self.limits.supply_high:
            self._supply_bad_since = None
        elif self._supply_bad_since is None:
            self._supply_bad_since = now

    def note_quality(self, sound: int, damaged: int, now: float) -> None:
        """Count lines or frames that came: with readings, and damaged ones."""
        self._line_quality.append((now, sound, damaged))
        while now - self._line_quality[0][0] > READING_WINDOW:
            self._line_quality.popleft()

    def _measure_rest(self, now: float) -> None:
        """Average readings of vented chambers into the rest pressures.

        They must be steady (also in the mean, so that air which leaves slowly is not taken for
        rest), plausible for a room, about the same in all chambers, and not higher than the rest
        that was measured before.
        """
        window = self._rest_window
        window.append((now, self.chamber_pressure))
        while window and now - window[0][0] > self.limits.rest_time * 1.5:
            window.pop(0)
        readings = np.array([reading for _, reading in window])
        self._rest_problem = self._unfit_for_rest(readings)
        if self._rest_problem:
            window.clear()
            return
        if now - window[0][0] < self.limits.rest_time:
            self._rest_problem = NOT_STEADY
            return
        half = len(readings) // 2
        drift = np.abs(readings[half:].mean(axis=0) - readings[:half].mean(axis=0))
        if np.max(drift) > self.limits.rest_drift:
            self._rest_problem = NOT_STEADY
            return
        self.rest_pressure = readings.mean(axis=0)
        self._lowest_rest = np.minimum(self._lowest_rest, self.rest_pressure)

    def _unfit_for_rest(self, readings: NDArray[np.float64]) -> str:
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
        if np.max(np.ptp(readings, axis=0)) > self.limits.rest_spread:
            return NOT_STEADY
        if np.max(newest - self._lowest_rest) > LARGEST_OFFSET:
            return (
                f"chambers rest {np.max(newest - self._lowest_rest):.0f} Pa higher than before: "
                "let trapped air out, or start the driver again"
            )
        return ""

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
        self._supply_at = None
        self._below_since = None
        self._bad_readings.clear()
        self._line_quality.clear()
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
            return [f"no telemetry: the last came {age:.1f} s ago"]
        return []

    def overpressure_faults(self) -> list[str]:
        """Say whether a chamber is over-pressurised."""
        if self._over_count < SAMPLES_TO_TRIP:
            return []
        worst = int(np.nanargmax(self.chamber_pressure))
        return [
            f"over-pressure in chamber {worst}: it reads {self.chamber_pressure[worst]:.0f} Pa, "
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
        """Say whether the supply has left its bounds, or is told no more."""
        # A board that is silent altogether is another fault.
        if self._must_tell_supply() and not self.telemetry_faults(now):
            age = None if self._supply_at is None else now - self._supply_at
            if age is not None and age > self.limits.telemetry_timeout + self.limits.supply_time:
                return [f"no reading of the supply: the last came {age:.1f} s ago"]
        since = self._supply_bad_since
        if since is None or now - since < self.limits.supply_time:
            return []
        return [self._supply_problem()]

    def supply_obstacles(self, now: float) -> list[str]:
        """Say why the supply forbids arming: no fresh reading, or one out of bounds."""
        stale = self._supply_at is None or now - self._supply_at > self.limits.telemetry_timeout
        if self._must_tell_supply() and stale:
            return ["the board has not told its supply pressure yet"]
        return [] if self._supply_bad_since is None else [self._supply_problem()]

    def _must_tell_supply(self) -> bool:
        return self._tells_supply and self.limits.supply_required

    def _supply_problem(self) -> str:
        if not np.isfinite(self.supply_pressure):
            return "no reading of the supply: the board reports that it is not a number"
        side = "low" if self.supply_pressure < self.limits.supply_low else "high"
        return (
            f"supply too {side}: {self.supply_pressure:.0f} Pa, allowed "
            f"{self.limits.supply_low:.0f} to {self.limits.supply_high:.0f} Pa absolute"
        )

    def reading_faults(self, now: float) -> list[str]:
        """Say whether a sensor reads nonsense, or the line damages much of what it carries."""
        found = []
        bad = self._bad_readings
        if len(bad) == MOST_BAD_READINGS and now - bad[0] <= READING_WINDOW:
            found.append(
                f"chamber {self._bad_chamber} has no plausible reading: {len(bad)} of the last "
                f"{READING_WINDOW:g} s were no number or outside {PLAUSIBLE_READING[0]:.0f} to "
                f"{PLAUSIBLE_READING[1]:.0f} Pa"
            )
        recent = [entry for entry in self._line_quality if now - entry[0] <= READING_WINDOW]
        damaged = sum(entry[2] for entry in recent)
        total = damaged + sum(entry[1] for entry in recent)
        if damaged >= MOST_DAMAGED and damaged >= DAMAGED_SHARE * total:
            found.append(
                f"damaged telemetry: {damaged} of {total} lines or frames in the last "
                f"{READING_WINDOW:g} s"
            )
        return found

    def below_rest_faults(self, now: float) -> list[str]:
        """Say whether a chamber reads less than at rest, which vented air cannot."""
        if self._below_since is None or now - self._below_since < BELOW_REST_TIME:
            return []
        return [
            "a chamber is below its rest pressure: the rest was measured with air trapped; "
            + self.describe_gauge()
        ]


def chamber_gauge(differential: Sequence[float]) -> NDArray[np.float64]:
    """Return the gauge pressures (2M,) [Pa] of pairs: one chamber vented, the other at |u|."""
    difference = np.asarray(differential, dtype=np.float64)
    return np.stack([np.maximum(difference, 0.0), np.maximum(-difference, 0.0)], axis=1).ravel()
