"""Decides on the share of feedback's corrections that is sent.

It goes from 0 to 1 once the limb is seen, and back to 0, which is the plan alone, where feedback
can do harm: the camera sees nothing, or what it sees does not fit the model; corrections swing on
and on; commands are asked for too late. Lost tags may come back; after the other reasons the rest
of the run is played without feedback. Corrections that a limb does not follow lose their share by
`der_planner.control.benefit`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.model import CONTROL_PERIOD

REASONS = {
    "tags lost": "the limb has not been seen for {:.1f} s",
    "inconsistent": "the limb moves as the model cannot, measurements are {:.0f} times too far off",
    "oscillation": "corrections swing by {:.0f} Pa, and neither they nor the limb come to rest",
    "late": "commands come {:.2f} s after their instant",
    "pressures": "chambers are said to hold {:.3g} Pa, which no command has made: are pressures "
    "told in Pa, and is the supply open?",
}
"""Every reason with the sentence of its warning."""
_GOES_ON = 0.7
"""Share of its largest swing below which something that swings begins or dies out."""
_RAMP = 1.0
"""Time in which feedback comes in [s]."""
_FADE = 1.5
"""Time in which feedback is taken back [s]."""
_BLIND = 0.5
"""Time without a measurement after which the tags are lost [s]."""
_KEPT = 1.0
"""Time after that in which the last disturbances are still made up for [s]."""
_INCONSISTENT = 20.0
"""Squared distance of measurements per coordinate, smoothed, that is too large; 1 is expected."""
_PATIENCE = 2.0
"""Time for which measurements may be inconsistent [s]."""
_SWING = 0.1
"""Way from one turn of a swinging correction to the next, as a share of the authority."""
_TURNS = 6
"""Number of turns within the window that are an oscillation, unless it begins or dies out."""
_WINDOW = 4.0
"""Time in which the turns are counted [s]."""
_STRANGE = 1.5
"""Time for which chambers may be said to hold what no command has made [s]."""
_LATE = 4.0
"""Number of commands that may come too late; one in time makes up for half of one."""


@dataclass(frozen=True)
class Warned:
    """A reason for which feedback was taken back.

    Attributes:
        time: [s] of the plan.
        name: one of `REASONS`.
        message: a sentence with its number.
    """

    time: float
    name: str
    message: str


class Supervisor:
    """Decides on the share of the corrections that is sent; see the module.

    Args:
        authority: largest correction [Pa].

    Attributes:
        share: 0 … 1.
        reason: for which feedback is out or going out; empty while it acts.
        warnings: all that were given.
    """

    def __init__(self, authority: float) -> None:
        self.authority = authority
        self.share = 0.0
        self.reason = ""
        self.warnings: list[Warned] = []
        self._latched = False
        self._since: dict[str, float] = {}
        self._late = 0.0
        self._recent: deque[tuple[Array, float]] = deque(maxlen=round(_WINDOW / CONTROL_PERIOD))

    def advance(self, time: float, age: float, strange: float) -> float:
        """Return the share of a command's correction.

        Args:
            time: instant of the command [s].
            age: of the newest measurement then [s].
            strange: squared distance of measurements per coordinate, smoothed.
        """
        if self._lasts("strange", strange > _INCONSISTENT, time) > _PATIENCE:
            self.stop(time, "inconsistent", strange)
        seen = age <= _BLIND
        if not seen and not self._latched and self.share > 0.0:
            self._warn(time, "tags lost", age)
        if seen and self.reason == "tags lost":
            self.reason = ""
        if self._latched or age > _BLIND + _KEPT:
            self.share = max(0.0, self.share - CONTROL_PERIOD / _FADE)
        elif seen:
            self.share = min(1.0, self.share + CONTROL_PERIOD / _RAMP)
        return self.share

    def sent(self, time: float, correction: Array, swing: float) -> None:
        """Look at a correction that is sent.

        Args:
            time: instant of the command [s].
            correction: (M,) [Pa].
            swing: rate at which the limb deviates from the model's motion then [rad/s].
        """
        self._recent.append((correction, swing))
        distance = self._oscillation()
        if distance > 0.0:
            self.stop(time, "oscillation", distance)

    def held(self, time: float, pressure: float, possible: bool) -> None:
        """Look at what chambers are said to hold [Pa], and whether commands can have made it."""
        if self._lasts("pressures", not possible, time) > _STRANGE:
            self.stop(time, "pressures", pressure)

    def _lasts(self, what: str, now: bool, time: float) -> float:
        """Return for how long something has been so at an instant, without a break [s]."""
        if not now:
            self._since.pop(what, None)
            return 0.0
        return time - self._since.setdefault(what, time)

    def _oscillation(self) -> float:
        """Return how far a correction swings [Pa] if it and the limb swing on and on; else 0.

        After a push they swing more than before, and later less. A correction that is cut at its
        limit swings as far as before while the limb's swing dies out.
        """
        if len(self._recent) < (self._recent.maxlen or 0):
            return 0.0
        corrections, swings = (np.array(each) for each in zip(*self._recent, strict=True))
        third, least = len(swings) // 3, _SWING * self.authority
        if min(swings[:third].max(), swings[-third:].max()) < _GOES_ON * swings.max():
            return 0.0
        for series in corrections.T:
            distance = float(np.ptp(series))
            away = series - (series.max() + series.min()) / 2
            sides = np.sign(away[np.abs(away) > least / 2])
            goes_on = min(np.ptp(series[:third]), np.ptp(series[-third:])) >= _GOES_ON * distance
            if goes_on and np.count_nonzero(np.diff(sides)) >= _TURNS:
                return distance
        return 0.0

    def late(self, time: float, by: float) -> None:
        """Note that a command came after its instant [s], and by how much [s]."""
        self._late += 1.0
        if self._late >= _LATE:
            self.stop(time, "late", by)

    def in_time(self) -> None:
        """Note that a command is in time; it makes up for half a late one."""
        self._late = max(0.0, self._late - 0.5)

    def stop(self, time: float, name: str, number: float) -> None:
        """Play the rest without feedback, for one of `REASONS` and the number in its sentence."""
        if not self._latched:
            self._latched = True
            self._warn(time, name, number)

    def _warn(self, time: float, name: str, number: float) -> None:
        if self.reason != name:
            self.reason = name
            self.warnings.append(Warned(time, name, REASONS[name].format(number)))
