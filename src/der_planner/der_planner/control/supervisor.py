"""Decides on the share of feedback's corrections that is sent.

It goes from 0 to 1 once the limb is seen, and back to 0, which is the plan alone, where feedback
can do harm: the camera sees nothing, or what it sees does not fit the model; commands are asked for
too late. Lost tags may come back; after the other reasons the rest of the run is played without
feedback. Once corrections have swung, only what is slow in them is sent. Corrections that a limb
does not follow lose their share by `der_planner.control.benefit`.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.model import CONTROL_PERIOD

REASONS = {
    "tags lost": "nothing newer than {:.1f} s has come of the limb: is it seen, and in time?",
    "inconsistent": "the limb moves as the model cannot, measurements are {:.0f} times too far "
    "off: is it this limb, does something hold it, and are they in rad, m and Pa, segment by "
    "segment from the clamp",
    "swings": "corrections swing by {:.0f} Pa, what is slow in them is sent from now on: does "
    "something touch the limb, or does it swing otherwise than its file says? Calibrate it again",
    "late": "commands come {:.2f} s after their instant",
    "pressures": "chambers are said to hold {:.3g} Pa, which no command has made: are pressures "
    "told in Pa, and is the supply open?",
}
"""Every reason with the sentence of its warning."""
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
_SLOW = 0.5
"""Time in which corrections go to another level, and of each of two low-passes once they swing
[s]."""
_SWING = 0.014
"""Distance from that level beyond which it swings, as a share of the authority."""
_TURNS = 3
"""Number of turns within the window that are a swing; friction that turns round makes one."""
_WINDOW = 1.5
"""Time in which they are counted [s]."""
_STRANGE = 1.5
"""Time for which chambers may be said to hold what no command has made [s]."""
_LATE = 4.0
"""Number of commands that may come too late; one in time makes up for half of one."""


@dataclass(frozen=True)
class Warned:
    """A reason for which feedback was taken back or slowed.

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
        swings: whether corrections have swung.
        reason: for which feedback is out or going out; empty while it acts.
        warnings: all that were given.
    """

    def __init__(self, authority: float) -> None:
        self.authority = authority
        self.share, self.swings = 0.0, False
        self.reason = ""
        self.warnings: list[Warned] = []
        self._latched = False
        self._since: dict[str, float] = {}
        self._late = 0.0
        self._slow = np.zeros((2, 1))
        self._fast: deque[Array] = deque(maxlen=round(_WINDOW / CONTROL_PERIOD))

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

    def calmed(self, time: float, correction: Array) -> Array:
        """Return what is sent of a correction (M,) [Pa] for an instant [s].

        Friction, loads and a wrong gain take corrections to another level. On a limb whose swing is
        not what the model says they go up and down, and drive it.
        """
        self._fast.append(correction - self._slow[0])
        self._slow = _followed(self._slow, correction)
        calm: Array = self._slow[1]
        if self.swings:
            return calm
        for series in np.array(self._fast).T:
            far = series[np.abs(series) > _SWING * self.authority]
            if np.count_nonzero(np.diff(np.sign(far))) >= _TURNS:
                self.swings = True
                self.warnings.append(Warned(time, "swings", REASONS["swings"].format(np.ptp(far))))
                break
        return correction

    def calmed_ahead(self, corrections: Array) -> Array:
        """Return what would be sent of coming corrections (W, M) [Pa], the first of them newest."""
        if not self.swings:
            return corrections
        slow = [self._slow]
        for each in corrections[1:]:
            slow.append(_followed(slow[-1], each))
        return np.array(slow)[:, 1]

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


def _followed(slow: Array, correction: Array) -> Array:
    """Return two low-passes, one after the other (2, M), a control period later."""
    share = CONTROL_PERIOD / _SLOW
    first = slow[0] + share * (correction - slow[0])
    return np.stack([first, slow[1] + share * (first - slow[1])])
