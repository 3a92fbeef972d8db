"""When feedback may act: its share, and the reasons for which it is taken back.

The share goes from 0 to 1 once the limb is seen. It goes back to 0, which is the plan alone, where
feedback can do harm: the camera sees nothing, or what it sees does not fit the model; corrections
swing, or stay at what they are allowed, and the tip is far from its path; commands are asked for
too late. Lost tags may come back; after the other reasons the rest of the run is played without
feedback.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.model import CONTROL_PERIOD

REASONS = {
    "tags lost": "the limb has not been seen for {:.1f} s",
    "inconsistent": "the limb moves as the model cannot, measurements are {:.0f} times too far off",
    "oscillation": "corrections swing by {:.0f} Pa, and neither they nor the limb come to rest",
    "saturation": "a correction is at its limit of {:.0f} Pa, and the tip far from its path",
    "late": "commands come {:.2f} s after their instant",
}
"""Every reason with the sentence of its warning."""


_GOES_ON = 0.7
"""Share of its largest swing below which something that swings begins or dies out."""


@dataclass(frozen=True)
class Limits:
    """When feedback is taken back.

    Attributes:
        authority: largest correction, as a share of the limb's pressure limit.
        ramp: time in which feedback comes in [s].
        fade: time in which it is taken back [s].
        blind: without a measurement for longer, the tags are lost [s].
        kept: time after that in which the last disturbances are still made up for [s].
        inconsistent: squared distance of measurements per coordinate, smoothed; 1 is expected.
        patience: for which measurements may be inconsistent [s].
        saturated: for which a correction may be at its limit [s].
        astray: neither a correction at its limit nor an oscillation ends feedback while the tip
            stays within this share of the limb's length from r̄: a limb that needs much, and
            follows, is not left to a plan that may be further off.
        swing: from one turn of a swinging correction to the next, as a share of the authority.
        turns: so many of them within the window are an oscillation, unless it begins or dies out.
        window: time in which the turns are counted [s].
        late: commands that come too late; one in time makes up for half of one.
    """

    authority: float = 0.4
    ramp: float = 1.0
    fade: float = 1.5
    blind: float = 0.5
    kept: float = 1.0
    inconsistent: float = 20.0
    patience: float = 2.0
    saturated: float = 3.0
    astray: float = 0.03
    swing: float = 0.1
    turns: int = 6
    window: float = 4.0
    late: float = 4.0


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
        limits: when feedback is taken back.
        authority: largest correction [Pa].
        length: of the limb [m].

    Attributes:
        share: 0 … 1.
        reason: for which feedback is out or going out; empty while it acts.
        warnings: all that were given.
    """

    def __init__(self, limits: Limits, authority: float, length: float = 1.0) -> None:
        self.limits, self.authority, self.length = limits, authority, length
        self.share = 0.0
        self.reason = ""
        self.warnings: list[Warned] = []
        self._latched = False
        self._strange_since: float | None = None
        self._limited_since: float | None = None
        self._late = 0.0
        self._astray_at = -math.inf
        self._recent: deque[tuple[Array, float]] = deque(
            maxlen=round(limits.window / CONTROL_PERIOD)
        )

    def take_over(self, other: Supervisor) -> None:
        """Go on with the share of another plan's feedback; what ended it does not count here."""
        self.share = other.share

    def advance(self, time: float, age: float, strange: float) -> float:
        """Return the share of a command's correction.

        Args:
            time: instant of the command [s].
            age: of the newest measurement then [s].
            strange: squared distance of measurements per coordinate, smoothed.
        """
        limits = self.limits
        if strange > limits.inconsistent:
            if self._strange_since is None:
                self._strange_since = time
            if time - self._strange_since > limits.patience:
                self.stop(time, "inconsistent", strange)
        else:
            self._strange_since = None
        seen = age <= limits.blind
        if not seen and not self._latched and self.share > 0.0:
            self._warn(time, "tags lost", age)
        if seen and self.reason == "tags lost":
            self.reason = ""
        if self._latched or age > limits.blind + limits.kept:
            self.share = max(0.0, self.share - CONTROL_PERIOD / limits.fade)
        elif seen:
            self.share = min(1.0, self.share + CONTROL_PERIOD / limits.ramp)
        return self.share

    def sent(self, time: float, correction: Array, swing: float, missed: float = math.inf) -> None:
        """Look at a correction that is sent.

        Args:
            time: instant of the command [s].
            correction: (M,) [Pa].
            swing: rate at which the limb deviates from the model's motion then [rad/s].
            missed: distance of the tip from r̄ then [m]; if nobody tells, it is far.
        """
        limits = self.limits
        astray = missed > limits.astray * self.length
        if astray:
            self._astray_at = time
        limited = np.abs(correction).max() > 0.98 * self.authority * self.share
        if self.share > 0.0 and limited and astray:
            if self._limited_since is None:
                self._limited_since = time
            if time - self._limited_since > limits.saturated:
                self.stop(time, "saturation", self.authority)
        else:
            self._limited_since = None
        self._recent.append((correction, swing))
        distance = self._oscillation()
        if distance > 0.0 and time - self._astray_at <= limits.window:
            self.stop(time, "oscillation", distance)

    def _oscillation(self) -> float:
        """Return how far a correction swings [Pa] if it and the limb swing on and on; else 0.

        After a push they swing more than before, and later less. A correction that is cut at its
        limit swings as far as before while the limb's swing dies out.
        """
        limits = self.limits
        if len(self._recent) < (self._recent.maxlen or 0):
            return 0.0
        corrections, swings = (np.array(each) for each in zip(*self._recent, strict=True))
        third, least = len(swings) // 3, limits.swing * self.authority
        if min(swings[:third].max(), swings[-third:].max()) < _GOES_ON * swings.max():
            return 0.0
        for series in corrections.T:
            distance = float(np.ptp(series))
            away = series - (series.max() + series.min()) / 2
            sides = np.sign(away[np.abs(away) > least / 2])
            goes_on = min(np.ptp(series[:third]), np.ptp(series[-third:])) >= _GOES_ON * distance
            if goes_on and np.count_nonzero(np.diff(sides)) >= limits.turns:
                return distance
        return 0.0

    def late(self, time: float, by: float) -> None:
        """Note that a command came after its instant [s], and by how much [s]."""
        self._late += 1.0
        if self._late >= self.limits.late:
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
