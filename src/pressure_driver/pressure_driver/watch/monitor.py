"""Watches what the board measures: is it alive, within limits, and does it follow its commands?"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pressure_driver.protocols.base import Telemetry
from pressure_driver.watch.following import Following
from pressure_driver.watch.limits import MonitorLimits
from pressure_driver.watch.rest import RestPressures

PLAUSIBLE_READING = (30_000.0, 400_000.0)
"""[Pa] A chamber that reads outside has a broken sensor or a damaged line."""
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
        self._rest = RestPressures(chamber_count, limits, atmosphere)
        self._following = Following(chamber_count, limits)
        self._last_telemetry: float | None = None
        self._over_count = 0
        self._supply_bad_since: float | None = None
        self._below_since: float | None = None
        self._supply_at: float | None = None
        self._tells_supply = tells_supply
        self._bad_readings: deque[float] = deque(maxlen=MOST_BAD_READINGS)
        self._bad_chamber = 0
        self._line_quality: deque[tuple[float, int, int]] = deque()
        self._sound = self._damaged = 0

    @property
    def rest_pressure(self) -> NDArray[np.float64]:
        """(2M,) [Pa] absolute, what each sensor reads when vented; NaN until measured."""
        return self._rest.pressure

    @property
    def atmosphere(self) -> float:
        """[Pa] mean of the rest pressures; NaN until measured."""
        return self._rest.mean

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
        return self._rest.known

    def rest_problem(self) -> str:
        """Return why the rest pressures are not known, or nothing if they are."""
        return self._rest.problem

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
        if resting:
            self._rest.receive(reading, now)
        else:
            self._rest.forget_readings()
        below = self.rest_known() and bool(np.min(self.gauge) < -BELOW_REST)
        if not below:
            self._below_since = None
        elif self._below_since is None:
            self._below_since = now
        self._following.receive(self.gauge, self.valve_opening, now)

    def _take_supply(self, pressure: float, now: float) -> None:
        self.supply_pressure, self._supply_at = pressure, now
        if self.limits.supply_low <= pressure <= self.limits.supply_high:
            self._supply_bad_since = None
        elif self._supply_bad_since is None:
            self._supply_bad_since = now

    def note_quality(self, sound: int, damaged: int, now: float) -> None:
        """Count lines or frames that came: with readings, and damaged ones."""
        self._line_quality.append((now, sound, damaged))
        self._sound += sound
        self._damaged += damaged
        self._forget_old_lines(now)

    def _forget_old_lines(self, now: float) -> None:
        while self._line_quality and now - self._line_quality[0][0] > READING_WINDOW:
            _, sound, damaged = self._line_quality.popleft()
            self._sound -= sound
            self._damaged -= damaged

    def command(self, differential: Sequence[float], now: float) -> None:
        """Tell what has just been commanded, for the following check.

        Args:
            differential: (M,) [Pa].
            now: [s] steady clock.
        """
        self._following.command(differential, now)

    def reset_following(self, now: float) -> None:
        """Start the following check afresh from what is measured now."""
        self._following.restart(self.gauge, now)

    def forget(self) -> None:
        """Forget the newest telemetry, as after a disconnect."""
        self._last_telemetry = None
        self._over_count = 0
        self._supply_bad_since = None
        self._supply_at = None
        self._below_since = None
        self._bad_readings.clear()
        self._line_quality.clear()
        self._sound = self._damaged = 0
        self._rest.forget_readings()
        self.chamber_pressure = np.full(self.chamber_count, np.nan)
        self.valve_opening = np.full(self.chamber_count, np.nan)
        self.supply_pressure = float("nan")

    def telemetry_faults(self, now: float) -> list[str]:
        """Say whether the board has gone silent."""
        age = self.telemetry_age(now)
        if self._last_telemetry is None:
            self._forget_old_lines(now)
            if self._damaged < MOST_DAMAGED:
                return ["no telemetry from the board yet"]
            return [
                f"no telemetry from the board yet: {self._damaged} lines or frames of the last "
                f"{READING_WINDOW:g} s are not of this language and number of chambers (see "
                "'last_damaged_line' in the diagnostics); look at 'protocol', 'baud_rate' and "
                "'segment_count'"
            ]
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
        """Say which chambers do not follow their commands, or lose air."""
        return self._following.faults(self.gauge, now)

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
        self._forget_old_lines(now)
        damaged, total = self._damaged, self._damaged + self._sound
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
