"""Does the board still hear, while the command does not change? A small change of it must show.

A board that echoes its commands says so itself. One that does not (`ezloop`) looks the same under a
steady command whether it listens or not: the pressures stay. So a command that has been steady for
a while is changed a little for some seconds, and the measured differential pressures must move with
it. A change that is not seen is repeated with twice the size, since the valves of a board have a
dead band; three in a row that are not seen are a fault.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pressure_driver.watch.limits import MonitorLimits

PROBE_TIME = 3.0
"""[s] of a change: the longest delay of a board (2 s), and `AVERAGE_TIME`."""
AVERAGE_TIME = 1.0
"""[s] over which readings are averaged before a change and at its end."""
FEWEST_READINGS = 5
"""In `AVERAGE_TIME`; with fewer the change is put off."""
SEEN_SHARE = 0.3
"""Of a change that must be measured: dead bands eat half of a small one."""
MOST_MISSES = 3
"""Changes in a row that may not be seen."""
LONGEST_PAUSE = 0.5
"""[s] without a tick that played setpoints, after which everything begins afresh."""

Change = tuple[float, ...]


class SteadyProbe:
    """Changes a steady command for a moment, and looks for it in the readings.

    Args:
        limits: `probe_pressure`, `probe_interval`.
        pressure_limit: [Pa] that no command passes.
    """

    def __init__(self, limits: MonitorLimits, pressure_limit: float) -> None:
        self.fault = ""
        """Why the board counts as deaf; empty while it does not."""
        self._limits = limits
        self._pressure_limit = pressure_limit
        self._readings: deque[tuple[float, NDArray[np.float64]]] = deque()
        self._target: Change = ()
        self._asked_at = -np.inf
        self.restart()

    def restart(self) -> None:
        """Forget what was seen, as at an arming."""
        self.fault = ""
        self._size = self._limits.probe_pressure
        self._misses = 0
        self._unseen: set[int] = set()
        self._begin_wait(self._asked_at, self._limits.probe_interval)

    def _begin_wait(self, now: float, seconds: float) -> None:
        self._next_at = now + seconds
        self._changed_at: float | None = None

    def receive(self, differential: NDArray[np.float64], now: float) -> None:
        """Take measured differential pressures (M,) [Pa]."""
        self._readings.append((now, differential))
        while now - self._readings[0][0] > AVERAGE_TIME:
            self._readings.popleft()

    def change(self, target: Sequence[float], now: float) -> Change:
        """Return what is to be commanded instead of a wanted differential pressure.

        Args:
            target: (M,) [Pa], what the setpoints want at this tick.
            now: [s] steady clock.
        """
        wanted = tuple(target)
        if wanted != self._target or now - self._asked_at > LONGEST_PAUSE:
            self._target = wanted
            self._begin_wait(now, self._limits.probe_interval)
        self._asked_at = now
        if self._size <= 0.0 or now < self._next_at:
            return wanted
        if self._changed_at is None:
            if len(self._readings) < FEWEST_READINGS:
                return wanted
            self._changed_at, self._before = now, self._mean()
            self._step = self._choose_step(wanted)
        if now - self._changed_at >= PROBE_TIME:
            self._judge(now)
            return wanted
        return tuple(np.add(wanted, self._step).tolist())

    def _mean(self) -> NDArray[np.float64]:
        mean: NDArray[np.float64] = np.mean([reading for _, reading in self._readings], axis=0)
        return mean

    def _choose_step(self, wanted: Change) -> NDArray[np.float64]:
        """Return the change (M,) [Pa]: more pressure, or less where more is not allowed."""
        values = np.array(wanted)
        side = np.where(values < 0.0, -1.0, 1.0)
        inward = np.abs(values) + self._size > self._pressure_limit
        return np.where(inward, -side, side) * self._size

    def _judge(self, now: float) -> None:
        """Compare the readings before the change with those at its end."""
        share = (self._mean() - self._before) / self._step if self._readings else 0.0 * self._step
        unseen = {int(segment) for segment in np.flatnonzero(share < SEEN_SHARE)}
        self._unseen = self._unseen & unseen if self._misses else unseen
        self._misses = self._misses + 1 if self._unseen else 0
        if self._misses >= MOST_MISSES:
            which = ", ".join(map(str, sorted(self._unseen)))
            self.fault = (
                f"the board does not hear, or valves stick: segment {which} did not move when a "
                f"steady command was changed by up to {self._size:.0f} Pa, {MOST_MISSES} times"
            )
        if self._unseen:
            self._size = min(2.0 * self._size, 0.5 * self._pressure_limit)
        self._begin_wait(now, PROBE_TIME if self._unseen else self._limits.probe_interval)
