"""Watches what the board measures: is it alive, within limits, and does the limb follow?"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, NamedTuple

from pressure_driver.following import Duration, Following, chamber_gauge
from pressure_driver.protocols import STANDARD_ATMOSPHERE, USUAL_LIMIT, HostProtocol, Telemetry

if TYPE_CHECKING:
    from pressure_driver.settings import Settings

BELOW_REST_TIME = 0.5
"""[s] that a chamber may read too little."""
SAMPLES_TO_TRIP = 2
"""Readings in a row: one damaged line of a protocol without checksum must not vent a limb."""
READING_WINDOW = 2.0
"""[s] over which bad readings and damaged lines are counted."""
MOST_BAD_READINGS = 8
"""In `READING_WINDOW`: a fifth at 20 Hz."""
MOST_DAMAGED = 10
"""Damaged lines or frames in `READING_WINDOW`, if they are also `DAMAGED_SHARE` of all."""
DAMAGED_SHARE = 0.3
STRANGE_TIME = 1.0
"""[s] in which bytes come of which nothing is understood: no piece of a line takes so long."""
PLAUSIBLE_ATMOSPHERE = (70_000.0, 105_000.0)
"""[Pa] at 3000 m, and above what the barometer reads at sea level but for a few days in a century:
chambers that rest higher hold trapped air, unless the parameter 'atmosphere' says otherwise."""
LARGEST_OFFSET = 1_000.0
"""[Pa] that the sensors of one board may differ by at rest, that a chamber may rest higher than it
did before, and that it may be below its rest pressure: more shows that the rest was taken under
pressure. This and the next two are in proportion for stronger limbs, whose sensors are coarser."""
REST_TIME = 1.0
"""[s] of steady readings that make a rest measurement."""
REST_SPREAD = 100.0
"""[Pa] that the readings of one rest measurement may differ by."""
REST_DRIFT = 20.0
"""[Pa] that the means of its two halves may differ by."""
NOT_STEADY = "chambers must be vented and steady"


class Condition(NamedTuple):
    """Something that is wrong with the line, the board, the supply or a chamber."""

    text: str
    """A sentence; only numbers stand behind its colon."""
    lasting: bool = True
    """It has lasted for its patience: it is a fault while armed. Before, it forbids arming only."""
    always: bool = False
    """It is a fault while disarmed, too."""


class RestPressures:
    """Averages readings of vented chambers.

    They must be steady (also in the mean, so that air which leaves slowly is not taken for rest),
    plausible for a room, about the same in all chambers, and not higher than the rest that was
    measured before.

    Args:
        chamber_count: 2M.
        settings: with the atmosphere, if it is known.
        resolution: [Pa] of one step of the readings, which may flicker by as much.
    """

    def __init__(self, chamber_count: int, settings: Settings, resolution: float) -> None:
        coarseness = max(1.0, settings.pressure_limit / USUAL_LIMIT)
        self.pressure = [settings.atmosphere or math.nan] * chamber_count
        """(2M,) [Pa] absolute, what each sensor reads when vented; NaN until measured."""
        self.mean = fmean(self.pressure)
        """[Pa] of them; NaN until they are all known."""
        self._given = bool(settings.atmosphere)
        self._largest_spread = REST_SPREAD * coarseness + resolution
        self._largest_drift = REST_DRIFT * coarseness + resolution / 2.0
        self.largest_offset = LARGEST_OFFSET * coarseness + resolution
        self._window: deque[tuple[float, Sequence[float]]] = deque()
        self.problem = NOT_STEADY
        """Why the newest reading ended no measurement; empty if it did."""
        self._lowest = [math.inf] * chamber_count

    @property
    def known(self) -> bool:
        """Whether every chamber's rest pressure has been measured or given."""
        return math.isfinite(self.mean)

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
        if problem := self._unfit(reading):
            self.problem = problem
            window.clear()
            return
        if now - window[0][0] < REST_TIME:
            self.problem = self.problem or NOT_STEADY
            return
        half = len(window) // 2
        chambers = list(zip(*(each for _, each in window), strict=True))
        drifts = [abs(fmean(values[half:]) - fmean(values[:half])) for values in chambers]
        self.problem = NOT_STEADY if max(drifts) > self._largest_drift else ""
        if self.problem:
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
        if most - least > self.largest_offset:
            return (
                f"chambers read {least:.0f} to {most:.0f} Pa: vented they agree within "
                f"{self.largest_offset:.0f} Pa"
            )
        for chamber, values in enumerate(zip(*(each for _, each in self._window), strict=True)):
            if (spread := max(values) - min(values)) > self._largest_spread:
                return (
                    f"{NOT_STEADY}, and the readings of chamber {chamber} differ by {spread:.0f} Pa"
                    f" (at most {self._largest_spread:.0f} Pa): look for air that leaves, or noise"
                )
        higher = max(now - before for now, before in zip(newest, self._lowest, strict=True))
        if higher > self.largest_offset:
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
        self.rest = RestPressures(count, settings, protocol.resolution)
        self.valve_opening = [math.nan] * count
        self.vented_tolerance = max(settings.vented_tolerance, 1.5 * protocol.resolution)
        """[Pa] gauge that counts as vented."""
        self.supply_pressure = math.nan
        self._plausible = (30_000.0, 370_000.0 + settings.over_pressure)
        """[Pa] A chamber that reads outside has a broken sensor or a damaged line."""
        self._settings = settings
        self._protocol = protocol
        self._following = [Following(chamber, settings) for chamber in range(count)]
        self._bad = 0, math.nan
        self.forget()

    def forget(self) -> None:
        """Forget the newest telemetry, as after a disconnect."""
        self.chamber_pressure: Sequence[float] = [math.nan] * self._protocol.chamber_count
        """(2M,) [Pa] absolute, as measured; NaN before the first reading."""
        self._read_at = math.nan
        self._supply_at = -math.inf
        self._changed_at = 0.0
        self._over_count = 0
        self._supply_bad = Duration()
        self._below_rest = Duration()
        self._lines: deque[tuple[float, int, int, int]] = deque()
        self._strange_since = math.nan
        self.rest.forget_readings()

    @property
    def gauge(self) -> list[float]:
        """(2M,) [Pa] measured pressures above those at rest; NaN while either is not known."""
        both = zip(self.chamber_pressure, self.rest.pressure, strict=True)
        return [reading - rest for reading, rest in both]

    def telemetry_age(self, now: float) -> float:
        """Return the age [s] of the newest chamber pressures; NaN before the first."""
        return now - self._read_at

    def describe_gauge(self) -> str:
        """Return the gauge pressures as text, in kPa."""
        return "gauge " + ", ".join(f"{value / 1000.0:.2f}" for value in self.gauge) + " kPa"

    def vented(self) -> bool:
        """Tell whether every chamber reads about its rest pressure."""
        return all(abs(value) <= self.vented_tolerance for value in self.gauge)

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
            supply = self.supply_pressure = telemetry.supply_pressure
            self._supply_at = now
            within = self._settings.supply_low <= supply <= self._settings.supply_high
            self._supply_bad.note(not within, now)
        if telemetry.valve_opening is not None:
            self.valve_opening = list(telemetry.valve_opening)
        reading = telemetry.chamber_pressure
        if reading is None:
            return
        low, high = self._plausible
        bad = [chamber for chamber, value in enumerate(reading) if not low < value < high]
        if bad:
            self._lines.append((now, 0, 0, 1))
            self._bad = bad[0], reading[bad[0]]
            return
        if tuple(reading) != tuple(self.chamber_pressure):
            self._changed_at = now
        self.chamber_pressure = reading
        if math.isnan(self._read_at):
            self.restart_following(now)
        self._read_at = now
        self._judge_pressures(now, resting)

    def _judge_pressures(self, now: float, resting: bool) -> None:
        reading, gauge = self.chamber_pressure, self.gauge
        over = max(gauge if self.rest.known else [p - STANDARD_ATMOSPHERE for p in reading])
        self._over_count = self._over_count + 1 if over > self._settings.over_pressure else 0
        if resting:
            self.rest.receive(reading, now)
        else:
            self.rest.forget_readings()
        gauge = self.gauge
        self._below_rest.note(min(gauge) < -self.rest.largest_offset, now)
        for chamber, value, opening in zip(self._following, gauge, self.valve_opening, strict=True):
            chamber.receive(value, opening, now)

    def count_lines(self, sound: int, damaged: int, understood: bool, now: float) -> None:
        """Count lines or frames that came: with readings, damaged; was any of them understood?"""
        self._lines.append((now, sound, damaged, 0))
        if understood:
            self._strange_since = math.nan
        elif math.isnan(self._strange_since):
            self._strange_since = now

    def _recent_lines(self, now: float) -> tuple[int, int, int]:
        """Return how many lines had readings, were damaged, had a reading that cannot be."""
        while self._lines and now - self._lines[0][0] > READING_WINDOW:
            self._lines.popleft()
        _, sound, damaged, bad = zip(*self._lines, strict=True) if self._lines else ((),) * 4
        return sum(sound), sum(damaged), sum(bad)

    # ------------------------------------------------------------------------------ faults

    def silence(self, now: float) -> str:
        """Return that the board is silent or speaks without being understood, or nothing."""
        age = self.telemetry_age(now)
        if math.isnan(age):
            _, damaged, bad = self._recent_lines(now)
            if bad >= MOST_BAD_READINGS:
                return self._describe_nonsense(bad)
            if damaged >= MOST_DAMAGED or now - self._strange_since > STRANGE_TIME:
                return (
                    "no telemetry from the board yet: what it sends is not of this language and "
                    f"number of chambers{self._last_damaged()}; look at 'protocol', 'baud_rate', "
                    "'segment_count' and its line ends"
                )
            return "no telemetry from the board yet; look at its power, its cable and 'port'"
        if age > self._settings.telemetry_timeout:
            _, damaged, _ = self._recent_lines(now)
            damage = f"; lines are damaged{self._last_damaged()}" if damaged else ""
            return f"no telemetry: the last came {age:.1f} s ago{damage}"
        patience = self._settings.frozen_time if self._protocol.tells_pascals else 0.0
        if 0.0 < patience < self._read_at - self._changed_at:
            return (
                f"telemetry is frozen: no reading has changed in {patience:g} s; where sensors are "
                "rounded, set the parameter 'frozen_time' to 0"
            )
        return ""

    def _last_damaged(self) -> str:
        line = self._protocol.last_damaged
        return line and f" (the last: {line})"

    def _describe_nonsense(self, count: int) -> str:
        (chamber, value), (low, high) = self._bad, self._plausible
        hint = ", as if the board told gauge pressures" if abs(value) < low else ""
        return (
            f"chamber {chamber} has no plausible reading: {value:.0f} Pa{hint}, and {count} of the "
            f"last {READING_WINDOW:g} s were no number or outside {low:.0f} to {high:.0f} Pa"
        )

    def following_faults(self, now: float) -> Iterator[str]:
        """Say which chambers do not follow their commands, or lose air."""
        for chamber in self._following:
            yield from chamber.faults(now)

    def conditions(self, now: float) -> Iterator[Condition]:
        """Say what is wrong with the telemetry, the pressures and the supply."""
        if silence := self.silence(now):
            # Other readings are old then: one cause, one reason.
            yield Condition(silence, lasting=not math.isnan(self._read_at))
            return
        if self._over_count >= SAMPLES_TO_TRIP:
            most = max(self.chamber_pressure)
            limit = self._settings.over_pressure
            yield Condition(
                f"over-pressure in chamber {list(self.chamber_pressure).index(most)}: it reads "
                f"{most:.0f} Pa, the limit is {limit:.0f} Pa above the atmosphere",
                always=True,
            )
        yield from self._supply_conditions(now)
        yield from self._line_conditions(now)
        if self._below_rest.until(now) >= BELOW_REST_TIME:
            yield Condition(
                "a chamber is below its rest pressure: the rest was measured with air trapped; "
                + self.describe_gauge()
            )
        if not self.rest.known:
            text = f"the rest pressures are not measured yet: {self.rest.problem}"
            yield Condition(text, lasting=False)
        elif not self.vented():
            text = "the chambers are not vented yet: " + self.describe_gauge()
            yield Condition(text, lasting=False)

    def _supply_conditions(self, now: float) -> Iterator[Condition]:
        settings, age = self._settings, now - self._supply_at
        if self._protocol.reports_supply and settings.supply_required:
            timeout = settings.telemetry_timeout
            if age > timeout:
                text = (
                    "the board has not told its supply pressure yet; one that cannot measure it "
                    "needs the parameter 'supply_required' at false"
                )
                if math.isfinite(age):
                    text = f"no reading of the supply: the last came {age:.1f} s ago"
                yield Condition(text, lasting=timeout + settings.supply_time < age < math.inf)
        bad_time = self._supply_bad.until(now)
        if bad_time < 0.0:
            return
        side = "low" if self.supply_pressure < settings.supply_low else "high"
        text = (
            f"supply too {side}: {self.supply_pressure:.0f} Pa, allowed "
            f"{settings.supply_low:.0f} to {settings.supply_high:.0f} Pa absolute"
        )
        if not math.isfinite(self.supply_pressure):
            text = "no reading of the supply: the board reports that it is not a number"
        yield Condition(text, lasting=bad_time >= settings.supply_time)

    def _line_conditions(self, now: float) -> Iterator[Condition]:
        """Say whether a sensor reads nonsense, or the line damages much of what it carries."""
        sound, damaged, bad = self._recent_lines(now)
        total = damaged + sound
        if bad >= MOST_BAD_READINGS:
            yield Condition(self._describe_nonsense(bad))
        if damaged >= MOST_DAMAGED and damaged >= DAMAGED_SHARE * total:
            yield Condition(
                f"damaged telemetry: {damaged} of {total} lines or frames in the last "
                f"{READING_WINDOW:g} s"
            )
