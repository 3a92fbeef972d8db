"""When feedback may act: its share, and the reasons for which it is taken back.

The share goes from 0 to 1 once the limb is seen. It goes back to 0, which is the plan alone, where
feedback can do harm: the camera sees nothing, or what it sees does not fit the model; corrections
swing; they stay at what they are allowed; commands are asked for too late. Lost tags may come back;
after the other reasons the rest of the run is played without feedback.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.model.series import CONTROL_PERIOD

Array = NDArray[np.float64]

REASONS = {
    "tags lost": "the limb has not been seen for {:.1f} s",
    "inconsistent": "the limb moves as the model cannot, measurements are {:.0f} times too far off",
    "oscillation": "the corrections swing by {:.0f} Pa and the swing does not die out",
    "saturation": "a correction has been at its limit of {:.0f} Pa for too long",
    "late": "commands are asked for {:.2f} s after their instant",
}
"""Every reason and what is said of it."""


@dataclass(frozen=True)
class Limits:
    """When feedback is taken back.

    Attributes:
        authority: largest correction, as a share of the limb's pressure limit.
        ramp: time in which feedback comes in [s].
        fade: time in which it is taken back [s].
        blind: without a measurement for longer, the tags are lost [s].
        kept: for so long after that the last disturbances are still counted with [s].
        inconsistent: squared distance of measurements per coordinate, smoothed; 1 is expected.
        patience: for which measurements may be inconsistent [s].
        saturated: for which a correction may be at its limit [s].
        swing: standard deviation of a correction that swings, as a share of the authority.
        window: in which swings are looked for [s].
        late: commands in a row that are asked for too late.
    """

    authority: float = 0.4
    ramp: float = 1.0
    fade: float = 1.5
    blind: float = 0.5
    kept: float = 1.0
    inconsistent: float = 20.0
    patience: float = 2.0
    saturated: float = 3.0
    swing: float = 0.08
    window: float = 4.0
    late: int = 4


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

    Attributes:
        share: 0 … 1.
        reason: for which feedback is out or going out; empty while it acts.
        warnings: all that were given.
    """

    def __init__(self, limits: Limits, authority: float) -> None:
        self.limits, self.authority = limits, authority
        self.share = 0.0
        self.reason = ""
        self.warnings: list[Warned] = []
        self._latched = False
        self._strange_since: float | None = None
        self._limited_since: float | None = None
        self._late = 0
        self._recent: deque[Array] = deque(maxlen=round(limits.window / CONTROL_PERIOD))

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

    def sent(self, time: float, correction: Array) -> None:
        """Look at a correction (M,) [Pa] that is sent for an instant [s]."""
        limits = self.limits
        if self.share > 0.0 and np.abs(correction).max() > 0.98 * self.authority * self.share:
            if self._limited_since is None:
                self._limited_since = time
            if time - self._limited_since > limits.saturated:
                self.stop(time, "saturation", self.authority)
        else:
            self._limited_since = None
        self._recent.append(correction)
        if len(self._recent) == self._recent.maxlen:
            self._look_for_swings(time)

    def asked(self, time: float, present: float) -> None:
        """Note that a command of an instant is asked for when so much is known [s]."""
        self._late = self._late + 1 if time <= present else 0
        if self._late >= self.limits.late:
            self.stop(time, "late", present - time)

    def stop(self, time: float, name: str, number: float) -> None:
        """Play the rest without feedback, for one of `REASONS` and the number in its sentence."""
        if not self._latched:
            self._latched = True
            self._warn(time, name, number)

    def _warn(self, time: float, name: str, number: float) -> None:
        if self.reason != name:
            self.reason = name
            self.warnings.append(Warned(time, name, REASONS[name].format(number)))

    def _look_for_swings(self, time: float) -> None:
        """Stop if a correction crossed its own mean often, by much, and no less toward the end."""
        recent = np.array(self._recent)
        place = np.linspace(-1.0, 1.0, len(recent))
        trend = np.polynomial.polynomial.polyfit(place, recent, 3)
        around = recent - np.polynomial.polynomial.polyval(place, trend).T
        half = len(recent) // 2
        early, late = around[:half].std(axis=0), around[half:].std(axis=0)
        crossings = (np.diff(np.sign(around), axis=0) != 0).sum(axis=0)
        often = crossings >= self.limits.window
        swinging = often & (late > self.limits.swing * self.authority) & (late > 0.8 * early)
        if swinging.any():
            self.stop(time, "oscillation", float(2 * np.sqrt(2) * late[swinging].max()))
