"""What was commanded and measured of the chambers, and what they will hold next."""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.control.nominal import STEP, Nominal, Whole
from der_planner.model import air
from der_planner.model.drive import STEPS
from der_planner.model.series import CONTROL_PERIOD, interpolate

Array = NDArray[np.float64]

_SURPRISE_TIME = 3.0
"""In which a difference between measured and modelled pressures is forgotten [s]."""
_LONGEST_HOLD = 40
"""Control periods without a command after which the plan's count again."""
_BEFORE = 60
"""Control periods before the first setpoint in which the limb may be watched."""
_GROWTH = 200
"""Control periods by which the table of commands grows."""
_KEPT = 6.0
"""Measured pressures are kept for this long [s]."""


class ChamberLog:
    """Chamber pressures of the past as measured, of the future by the law of the air.

    Between two readings the pressures are on a straight line. After the last one the model's
    pressures under the commands hold, with the difference that the last reading showed, which is
    forgotten within some seconds.

    Args:
        nominal: of the plan.
    """

    def __init__(self, nominal: Nominal) -> None:
        self._nominal = nominal
        self._inputs = nominal.limb.segment_count
        self._times: list[float] = []
        self._readings: list[Array] = []
        self._gap: Array | None = None
        self._last: int | None = None
        self._remembered = int(np.ceil(air.memory_of(nominal.limb.pneumatics) / CONTROL_PERIOD))
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
        while self._times[0] < self._times[-1] - _KEPT:
            del self._times[0], self._readings[0]
            place -= 1
        self._gap = None
        return self._times[place - 1] if place > 0 else time

    def send(self, k: int, command: Array) -> None:
        """Keep the command (M,) [Pa] of control period ``k``; it held since the last one sent."""
        table = self._table(k)
        row = k - self._origin
        if self._last is not None and 0 < k - self._last <= _LONGEST_HOLD:
            held = self._last - self._origin
            table[held + 1 : row] = table[held]
        table[row] = command
        self._last = k if self._last is None else max(k, self._last)
        self._gap = None

    def sent(self, k: int) -> Array:
        """Return the command (M,) of a control period [Pa]; the plan's if none was sent."""
        row: Array = self._table(k)[k - self._origin]
        return row

    def _table(self, k: int) -> Array:
        """Return the commands from period ``_origin`` on, to ``k`` and beyond."""
        missing = k + 1 - self._origin - len(self._commands)
        if missing > 0:
            first = self._origin + len(self._commands)
            more = [self._nominal.command(j) for j in range(first, first + missing + _GROWTH)]
            self._commands = np.concatenate([self._commands, np.array(more)])
        return self._commands

    def follow(self, first: int, coming: Array) -> tuple[air.Chambers, int]:
        """Return the chambers under what was sent before period ``first`` and what is coming.

        Args:
            first: period of the first coming command.
            coming: (W, M) [Pa].

        Returns:
            The chambers, and how many periods of them come before ``first``.
        """
        begin = max(first - self._remembered, self._origin + 1)
        table = self._table(first)
        past = table[begin - self._origin : first - self._origin]
        chambers = air.follow_commands(
            self._nominal.limb.pneumatics,
            np.concatenate([past, coming]),
            CONTROL_PERIOD,
            STEPS,
            self.sent(begin - 1),
        )
        return chambers, first - begin

    def during(self, steps: Whole) -> Array:
        """Return the differential pressures (n, M) [Pa] amid consecutive fine steps (n,)."""
        middle = STEP * (steps.astype(np.float64) + 0.5)
        known = middle <= self.newest
        result = np.empty((len(steps), self._inputs))
        if known.any():
            result[known] = interpolate(
                middle[known], np.array(self._times), np.array(self._readings)
            )
        if not known.all():
            coming = self.model(steps[~known])
            coming += self.surprise(middle[~known])
            result[~known] = coming
        return result

    def model(self, steps: Whole) -> Array:
        """Return the modelled differential pressures (n, M) [Pa] amid fine steps (n,)."""
        first, last = int(steps[0]) // STEPS, int(steps[-1]) // STEPS
        coming = self._table(last)[first - self._origin : last + 1 - self._origin]
        chambers, before = self.follow(first, coming)
        held = chambers.differential[before:].reshape(-1, self._inputs)
        return held[steps - first * STEPS]

    def surprise(self, time: Array) -> Array:
        """Return what the last reading shows beyond the model (n, M) [Pa], at instants after it."""
        if not self._times:
            return np.zeros((len(time), self._inputs))
        last = self._times[-1]
        if self._gap is None:
            place = last / STEP - 0.5
            step = int(np.floor(place))
            pair = self.model(np.array([step, step + 1]))
            between = pair[0] + (place - step) * (pair[1] - pair[0])
            self._gap = self._readings[-1] - between
        faded: Array = np.exp(-(time - last) / _SURPRISE_TIME)[:, None] * self._gap
        return faded
