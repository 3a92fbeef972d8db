"""Watches what the board measures: is it alive, within limits, and does the limb follow?"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from statistics import fmean

from pressure_driver.following import Following, chamber_gauge
from pressure_driver.protocols.base import STANDARD_ATMOSPHERE, HostProtocol, Telemetry
from pressure_driver.settings import Settings

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
FROZEN_TIME = 2.0
"""[s] in which the readings of working sensors differ, on boards that tell them to 1 Pa: in logs of
a real board no two in a row were alike."""
PLAUSIBLE_ATMOSPHERE = (70_000.0, 105_000.0)
"""[Pa] at 3000 m, and above what the barometer reads at sea level but for a few days in a century:
chambers that rest higher hold trapped air, unless the parameter 'atmosphere' says otherwise."""
LARGEST_OFFSET = 1_000.0
"""[Pa] that the sensors of one board may differ by at rest, and that a chamber may rest higher than
it did before."""
REST_TIME = 1.0
"""[s] of steady readings that make a rest measurement."""
REST_SPREAD = 100.0
"""[Pa] that the readings of one rest measurement may differ by."""
REST_DRIFT = 20.0
"""[Pa] that the means of its two halves may differ by."""
NOT_STEADY = "chambers must be vented and steady"


class RestPressures:
    """Averages readings of vented chambers.

    They must be steady (also in the mean, so that air which leaves slowly is not taken for rest),
    plausible for a room, about the same in all chambers, and not higher than the rest that was
    measured before.

    Args:
        chamber_count: 2M.
        atmosphere: [Pa] absolute if it is known; 0 to measure it.
    """

    def __init__(self, chamber_count: int, atmosphere: float = 0.0) -> None:
        self.pressure = [atmosphere or math.nan] * chamber_count
        """(2M,) [Pa] absolute, what each sensor reads when vented; NaN until measured."""
        self.mean = fmean(self.pressure)
        """[Pa] of them; NaN until they are all known."""
        self._given = bool(atmosphere)
        self._window: deque[tuple[float, Sequence[float]]] = deque()
        self._problem = NOT_STEADY
        self._lowest = [math.inf] * chamber_count

    @property
    def known(self) -> bool:
        """Whether every chamber's rest pressure has been measured or given."""
        return math.isfinite(self.mean)

    @property
    def problem(self) -> str:
        """Why the rest pressures are not known; nothing if they are."""
        return "" if self.known else f"the rest pressures are not measured yet: {self._problem}"

    def forget_readings(self) -> None:
        """Begin the next measurement afresh."""
        self._window.clear()

    def receive(self, reading: Sequence[float], now: float) -> None:
        """Take a reading (2M,) [Pa] of chambers that have been commanded to vent."""
        if self._given:
            return
        window = self._window
        window.append((now, reading))
        while now - window[0][0] > 1.5 * REST_TIME:
            window.popleft()
        self._problem = self._unfit(reading)
        if self._problem:
            window.clear()
            return
        half = len(window) // 2
        chambers = list(zip(*(each for _, each in window), strict=True))
        if now - window[0][0] < REST_TIME or any(
            abs(fmean(values[half:]) - fmean(values[:half])) > REST_DRIFT for values in chambers
        ):
            self._problem = NOT_STEADY
            return
        self.pressure = [fmean(values) for values in chambers]
        self.mean = fmean(self.pressure)
        self._lowest = list(map(min, self._lowest, self.pressure))

    def _unfit(self, newest: Sequence[float]) -> str:
        """Return why the window with its newest reading cannot be rest pressures, or nothing."""
        low, high = PLAUSIBLE_ATMOSPHERE
        least, most = min(newest), max(newest)
        if least < low or most > high:
            return (
                f"chambers read {least:.0f} to {most:.0f} Pa, no room has that ({low:.0f} to "
                f"{high:.0f} Pa): let trapped air out, or set the parameter 'atmosphere' to what a "
                "barometer reads"
            )
        if most - least > LARGEST_OFFSET:
            return (
                f"chambers read {least:.0f} to {most:.0f} Pa: vented they agree within "
                f"{LARGEST_OFFSET:.0f} Pa"
            )
        chambers = zip(*(each for _, each in self._window), strict=True)
        if any(max(values) - min(values) > REST_SPREAD for values in chambers):
            return NOT_STEADY
        higher = max(now - before for now, before in zip(newest, self._lowest, strict=True))
        if higher > LARGEST_OFFSET:
            return (
                f"chambers rest {higher:.0f} Pa higher than before: let trapped air out, or start "
                "the driver again"
            )
        return ""


class TelemetryMonitor:
    """Keeps the newest telemetry and says what is wrong with it.

    Args:
        protocol: what the board tells.
        settings: bounds of normal operation.
    """

    def __init__(self, protocol: HostProtocol, settings: Settings) -> None:
        count = protocol.chamber_count
        self.settings = settings
        self.rest = RestPressures(count, settings.atmosphere)
        self.valve_opening = [math.nan] * count
        self.supply_pressure = math.nan
        self._protocol = protocol
        self._following = [Following(chamber, settings) for chamber in range(count)]
        self._must_tell_supply = protocol.reports_supply and settings.supply_required
        self._bad_chamber = 0
        self.forget()

    def forget(self) -> None:
        """Forget the newest telemetry, as after a disconnect."""
        self.chamber_pressure: Sequence[float] = [math.nan] * self._protocol.chamber_count
        """(2M,) [Pa] absolute, as measured; NaN before the first reading."""
        self._read_at: float | None = None
        self._changed_at = 0.0
        self._over_count = 0
        self._supply_at: float | None = None
        self._supply_bad_since: float | None = None
        self._below_since: float | None = None
        self._bad_readings: deque[float] = deque(maxlen=MOST_BAD_READINGS)
        self._line_quality: deque[tuple[float, int, int]] = deque()
        self._sound = self._damaged = 0
        self.rest.forget_readings()

    @property
    def gauge(self) -> list[float]:
        """(2M,) [Pa] measured pressures above those at rest; NaN while either is not known."""
        both = zip(self.chamber_pressure, self.rest.pressure, strict=True)
        return [reading - rest for reading, rest in both]

    @property
    def heard(self) -> bool:
        """Whether chamber pressures have come since the port was opened."""
        return self._read_at is not None

    def telemetry_age(self, now: float) -> float:
        """Return the age [s] of the newest chamber pressures; NaN before the first."""
        return math.nan if self._read_at is None else now - self._read_at

    def describe_gauge(self) -> str:
        """Return the gauge pressures as text, in kPa."""
        return "gauge " + ", ".join(f"{value / 1000.0:.2f}" for value in self.gauge) + " kPa"

    def vented(self) -> bool:
        """Tell whether every chamber reads about its rest pressure."""
        return all(abs(value) <= self.settings.vented_tolerance for value in self.gauge)

    # ---------------------------------------------------------------------------- readings

    def command(self, differential: Sequence[float], now: float) -> None:
        """Tell what has just been commanded (M,) [Pa] (steady clock [s])."""
        for chamber, pressure in zip(self._following, chamber_gauge(differential), strict=True):
            chamber.command(pressure, now)

    def restart_following(self, now: float) -> None:
        """Start to compare with the commands afresh, from what is measured now."""
        for chamber, gauge in zip(self._following, self.gauge, strict=True):
            chamber.restart(gauge, now)

    def receive(self, telemetry: Telemetry, now: float, resting: bool) -> None:
        """Take one telemetry message.

        Args:
            telemetry: decoded.
            now: [s] steady clock.
            resting: the chambers have been commanded to vent, so rest pressures may be measured.
        """
        if telemetry.supply_pressure is not None:
            self._receive_supply(telemetry.supply_pressure, now)
        if telemetry.valve_opening is not None:
            self.valve_opening = list(telemetry.valve_opening)
        reading = telemetry.chamber_pressure
        if reading is None:
            return
        low, high = PLAUSIBLE_READING
        bad = [chamber for chamber, value in enumerate(reading) if not low < value < high]
        if bad:
            self._bad_readings.append(now)
            self._bad_chamber = bad[0]
            return
        if tuple(reading) != tuple(self.chamber_pressure):
            self._changed_at = now
        self.chamber_pressure = reading
        if self._read_at is None:
            self.restart_following(now)
        self._read_at = now
        known = self.rest.known
        reference = self.rest.pressure if known else [STANDARD_ATMOSPHERE] * len(reading)
        over = max(a - b for a, b in zip(reading, reference, strict=True))
        self._over_count = self._over_count + 1 if over > self.settings.over_pressure else 0
        if resting:
            self.rest.receive(reading, now)
        else:
            self.rest.forget_readings()
        gauge = self.gauge
        if not min(gauge) < -BELOW_REST:
            self._below_since = None
        elif self._below_since is None:
            self._below_since = now
        for chamber, value, opening in zip(self._following, gauge, self.valve_opening, strict=True):
            chamber.receive(value, opening, now)

    def _receive_supply(self, pressure: float, now: float) -> None:
        self.supply_pressure, self._supply_at = pressure, now
        if self.settings.supply_low <= pressure <= self.settings.supply_high:
            self._supply_bad_since = None
        elif self._supply_bad_since is None:
            self._supply_bad_since = now

    def count_lines(self, sound: int, damaged: int, now: float) -> None:
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

    # ------------------------------------------------------------------------------ faults

    def telemetry_faults(self, now: float) -> list[str]:
        """Say whether the board is silent, or speaks without being understood."""
        if self._read_at is None:
            self._forget_old_lines(now)
            if self._damaged < MOST_DAMAGED:
                return ["no telemetry from the board yet"]
            return [
                f"no telemetry from the board yet: {self._damaged} lines or frames of the last "
                f"{READING_WINDOW:g} s are not of this language and number of chambers (see "
                "'last_damaged_line' in the diagnostics); look at 'protocol', 'baud_rate' and "
                "'segment_count'"
            ]
        age = now - self._read_at
        if age > self.settings.telemetry_timeout:
            return [f"no telemetry: the last came {age:.1f} s ago"]
        if self._protocol.tells_pascals and self._read_at - self._changed_at > FROZEN_TIME:
            return [f"telemetry is frozen: no reading has changed in {FROZEN_TIME:g} s"]
        return []

    def overpressure_faults(self) -> list[str]:
        """Say whether a chamber is over-pressurised."""
        if self._over_count < SAMPLES_TO_TRIP:
            return []
        most = max(self.chamber_pressure)
        return [
            f"over-pressure in chamber {list(self.chamber_pressure).index(most)}: it reads "
            f"{most:.0f} Pa, the limit is {self.settings.over_pressure:.0f} Pa above the atmosphere"
        ]

    def following_faults(self, now: float) -> Iterator[str]:
        """Say which chambers do not follow their commands, or lose air."""
        for chamber in self._following:
            yield from chamber.faults(now)

    def supply_faults(self, now: float) -> list[str]:
        """Say whether the supply has left its bounds, or is told no more."""
        longest = self.settings.telemetry_timeout + self.settings.supply_time
        if self._must_tell_supply and self._supply_at is not None:
            age = now - self._supply_at
            # A board that is silent altogether is another fault.
            if age > longest and not self.telemetry_faults(now):
                return [f"no reading of the supply: the last came {age:.1f} s ago"]
        since = self._supply_bad_since
        if since is None or now - since < self.settings.supply_time:
            return []
        return [self._supply_problem()]

    def supply_obstacles(self, now: float) -> list[str]:
        """Say why the supply forbids arming: no fresh reading, or one out of bounds."""
        stale = self._supply_at is None or now - self._supply_at > self.settings.telemetry_timeout
        if self._must_tell_supply and stale:
            return ["the board has not told its supply pressure yet"]
        return [] if self._supply_bad_since is None else [self._supply_problem()]

    def _supply_problem(self) -> str:
        if not math.isfinite(self.supply_pressure):
            return "no reading of the supply: the board reports that it is not a number"
        side = "low" if self.supply_pressure < self.settings.supply_low else "high"
        return (
            f"supply too {side}: {self.supply_pressure:.0f} Pa, allowed "
            f"{self.settings.supply_low:.0f} to {self.settings.supply_high:.0f} Pa absolute"
        )

    def reading_faults(self, now: float) -> list[str]:
        """Say whether a sensor reads nonsense, or the line damages much of what it carries."""
        found = []
        bad = self._bad_readings
        if len(bad) == MOST_BAD_READINGS and now - bad[0] <= READING_WINDOW:
            low, high = PLAUSIBLE_READING
            found.append(
                f"chamber {self._bad_chamber} has no plausible reading: {len(bad)} of the last "
                f"{READING_WINDOW:g} s were no number or outside {low:.0f} to {high:.0f} Pa"
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
