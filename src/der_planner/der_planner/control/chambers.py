"""The chambers' commands and readings so far, and their expected pressures."""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array
from der_planner.control.nominal import STEP, Nominal, Whole
from der_planner.model import STEPS
from der_planner.model.air import Chambers
from der_planner.model.series import CONTROL_PERIOD, interpolate

_GAP_TIME = 10.0
"""Time in which a difference between measured and modelled pressures is expected to fade [s]."""
_GROWTH_TIME = 0.5
"""Time in which the growth of that difference fades [s]."""
_GROWTH_SEEN = 0.3
"""Span of the last readings from which that growth is taken [s]."""
_LONGEST_HOLD = 40
"""Number of control periods without a command after which the plan's commands count again."""
_BEFORE = 60
"""Number of control periods before the first setpoint in which the limb may be watched."""
_GROWTH = 200
"""Number of control periods by which the table of commands grows."""
_KEPT = 6.0
"""Age up to which measured pressures are kept [s]."""


class ChamberLog:
    """Chamber pressures of the past as measured, of the future by the law of the air.

    Between two readings the pressures are on a straight line. After the last one the model's
    pressures under the commands hold, with the difference that the last readings showed. What a
    learned plan knows its chambers to hold beyond their model is left out of all of them: the tip
    that the plan expects has it already.

    Args:
        nominal: of the plan.
        kept: readings are kept for this long [s].
    """

    def __init__(self, nominal: Nominal, kept: float = _KEPT) -> None:
        self._nominal, self._kept = nominal, kept
        self._inputs = nominal.model.inputs
        self._times: list[float] = []
        self._readings: list[Array] = []
        self._gap: tuple[Array, Array] | None = None
        self._last: int | None = None
        self._remembered = int(np.ceil(nominal.model.air.memory / CONTROL_PERIOD))
        self._origin = -self._remembered - _BEFORE
        self._commands = np.tile(nominal.before, (-self._origin, 1))

    @property
    def newest(self) -> float:
        """Instant of the newest reading [s]; −∞: none."""
        return self._times[-1] if self._times else -np.inf

    def read(self, time: float, differential: ArrayLike) -> float | None:
        """Keep a reading (M,) [Pa]; return from when on pressures changed by it [s], None: nowhere.

        Raises:
            ValueError: the reading has another shape.
        """
        values = np.asarray(differential, dtype=float)
        if values.shape != (self._inputs,):
            raise ValueError(
                f"expected {self._inputs} differential pressures, got shape {values.shape}"
            )
        if not np.isfinite(values).all():
            return None
        place = bisect.bisect_left(self._times, time)
        if place < len(self._times) and self._times[place] == time:
            self._readings[place] = values
        else:
            self._times.insert(place, time)
            self._readings.insert(place, values)
        while self._times[0] < self._times[-1] - self._kept:
            del self._times[0], self._readings[0]
            place -= 1
        self._gap = None
        return self._times[place - 1] if place > 0 else time

    def take_over(self, other: ChamberLog, periods: int) -> None:
        """Go on from the log of another plan, whose control period ``periods`` is this one's 0."""
        self._times = [time - periods * CONTROL_PERIOD for time in other._times]
        self._readings = list(other._readings)
        self._commands = np.array([other.sent(periods + k) for k in range(self._origin, 0)])
        self._last, self._gap = -1, None

    def send(self, k: int, command: Array) -> None:
        """Keep the command (M,) [Pa] of control period ``k``; it held since the last one sent."""
        table = self._table(k)
        row = k - self._origin
        if self._last is not None and 0 < k - self._last <= _LONGEST_HOLD:
            last = self._last - self._origin
            table[last + 1 : row] = table[last]
        table[row] = command
        self._last = k if self._last is None else max(k, self._last)
        self._gap = None

    def sent(self, k: int) -> Array:
        """Return the command (M,) of a control period [Pa]; the plan's if none was sent."""
        row: Array = self._table(k)[max(k - self._origin, 0)]
        return row

    def _table(self, k: int) -> Array:
        """Return the commands from period ``_origin`` on, to ``k`` and beyond."""
        missing = k + 1 - self._origin - len(self._commands)
        if missing > 0:
            first = self._origin + len(self._commands)
            more = [self._nominal.command(j) for j in range(first, first + missing + _GROWTH)]
            self._commands = np.concatenate([self._commands, np.array(more)])
        return self._commands

    def follow(self, first: int, coming: Array) -> tuple[Chambers, int]:
        """Return the chambers under the commands sent before period ``first`` and the coming ones.

        Args:
            first: period of the first coming command.
            coming: (W, M) [Pa].

        Returns:
            The chambers, and how many periods of them come before ``first``.
        """
        begin = max(first - self._remembered, self._origin + 1)
        table = self._table(first)
        past = table[begin - self._origin : first - self._origin]
        chambers = self._nominal.model.air.follow(
            np.concatenate([past, coming]),
            CONTROL_PERIOD,
            STEPS,
            self.sent(begin - 1),
        )
        return chambers, first - begin

    def during(self, steps: Whole) -> Array:
        """Return the differential pressures (n, M) [Pa] amid consecutive fine steps (n,)."""
        middle = STEP * (steps.astype(np.float64) + 0.5)
        known = (middle <= self.newest) & self._nominal.watched
        result = np.empty((len(steps), self._inputs))
        if known.any():
            readings = interpolate(middle[known], np.array(self._times), np.array(self._readings))
            result[known] = readings - self._nominal.chambers_beyond(middle[known])
        if not known.all():
            coming = self.model(steps[~known])
            coming += self.expected_gap(middle[~known])
            result[~known] = coming
        return result

    def model(self, steps: Whole) -> Array:
        """Return the modelled differential pressures (n, M) [Pa] amid fine steps (n,)."""
        first, last = int(steps[0]) // STEPS, int(steps[-1]) // STEPS
        coming = self._table(last)[first - self._origin : last + 1 - self._origin]
        chambers, before = self.follow(first, coming)
        differential = chambers.differential[before:].reshape(-1, self._inputs)
        return differential[steps - first * STEPS]

    def expected_gap(self, time: Array) -> Array:
        """Return the expected differences (n, M) [Pa] of the chambers from their model.

        The difference of the last reading fades within `_GAP_TIME`; first it goes on growing as it
        did in the last readings, for about `_GROWTH_TIME`: a chamber that vents more slowly than
        its model is left behind further and further.

        Args:
            time: (n,) instants after the last reading [s].
        """
        if not self._times or not self._nominal.watched:
            return np.zeros((len(time), self._inputs))
        if self._gap is None:
            self._gap = self._last_gap()
        gap, growth = self._gap
        ahead = (time - self._times[-1])[:, None]
        grown = _GROWTH_TIME * (1.0 - np.exp(-ahead / _GROWTH_TIME))
        expected: Array = np.exp(-ahead / _GAP_TIME) * gap + grown * growth
        return expected

    def _last_gap(self) -> tuple[Array, Array]:
        """Return the last reading less the model (M,) [Pa], and how fast that grows [Pa/s]."""
        last = self._times[-1]
        begin = bisect.bisect_left(self._times, last - _GROWTH_SEEN)
        instants = np.array(self._times[begin:])
        steps = np.arange(
            int(np.floor(instants[0] / STEP - 0.5)), int(np.floor(last / STEP - 0.5)) + 2
        )
        middles = STEP * (steps.astype(np.float64) + 0.5)
        gaps = np.array(self._readings[begin:]) - interpolate(instants, middles, self.model(steps))
        gaps -= self._nominal.chambers_beyond(instants)
        away = instants - last
        if len(away) < 3 or np.ptp(away) < _GROWTH_SEEN / 2:
            return gaps[-1], np.zeros(self._inputs)
        slope = (away - away.mean()) @ (gaps - gaps.mean(axis=0)) / np.var(away) / len(away)
        return gaps[-1], slope
