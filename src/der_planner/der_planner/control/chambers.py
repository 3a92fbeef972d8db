"""What was commanded and measured of the chambers, and what they will hold next."""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.control.nominal import STEP, Nominal
from der_planner.model import air
from der_planner.model.drive import STEPS
from der_planner.model.series import CONTROL_PERIOD, interpolate

Array = NDArray[np.float64]

_SURPRISE_TIME = 1.0
"""In which a difference between measured and modelled pressures is forgotten [s]."""
_LONGEST_HOLD = 40
"""Control periods without a command after which the plan's count again."""
_KEPT = 6.0
"""Measured pressures are kept for this long [s]."""


class ChamberLog:
    """Chamber pressures of the past as measured, of the future by the law of the air.

    Between two readings the pressures are on a straight line. After the last one the model's
    pressures under the commands hold, with the difference that the last reading showed, which is
    forgotten within a second or two.

    Args:
        nominal: of the plan.
    """

    def __init__(self, nominal: Nominal) -> None:
        self._nominal = nominal
        self._inputs = nominal.limb.segment_count
        self._times: list[float] = []
        self._readings: list[Array] = []
        self._sent: dict[int, Array] = {}
        self._remembered = int(np.ceil(air.memory_of(nominal.limb.pneumatics) / CONTROL_PERIOD))

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
        return self._times[place - 1] if place > 0 else time

    def send(self, k: int, command: Array) -> None:
        """Keep the command (M,) [Pa] of control period ``k``; it held since the last one sent."""
        before = k - 1
        while before >= k - _LONGEST_HOLD and before not in self._sent:
            before -= 1
        for between in range(before + 1, k):
            if before in self._sent:
                self._sent[between] = self._sent[before]
        self._sent[k] = command
        self._sent.pop(k - 4 * self._remembered - 400, None)

    def sent(self, k: int) -> Array:
        """Return the command (M,) of a control period [Pa]; the plan's if none was sent."""
        kept = self._sent.get(k)
        return self._nominal.command(k) if kept is None else kept

    def follow(self, first: int, coming: Array) -> tuple[air.Chambers, int]:
        """Return the chambers under what was sent before period ``first`` and what is coming.

        Args:
            first: period of the first coming command.
            coming: (W, M) [Pa].

        Returns:
            The chambers, and how many periods of them come before ``first``.
        """
        begin = first - self._remembered
        past = np.array([self.sent(k) for k in range(begin, first)])
        chambers = air.follow_commands(
            self._nominal.limb.pneumatics,
            np.concatenate([past, coming]) if len(coming) else past,
            CONTROL_PERIOD,
            STEPS,
            self.sent(begin - 1),
        )
        return chambers, self._remembered

    def during(self, steps: NDArray[np.int64]) -> Array:
        """Return the differential pressures (n, M) [Pa] amid consecutive fine steps (n,)."""
        middle = (steps + 0.5) * STEP
        known = middle <= self.newest
        result = np.empty((len(steps), self._inputs))
        if known.any():
            result[known] = interpolate(
                middle[known], np.array(self._times), np.array(self._readings)
            )
        if not known.all():
            result[~known] = self.model(steps[~known]) + self.surprise(middle[~known])
        return result

    def model(self, steps: NDArray[np.int64]) -> Array:
        """Return the modelled differential pressures (n, M) [Pa] amid fine steps (n,)."""
        first, last = int(steps[0]) // STEPS, int(steps[-1]) // STEPS
        coming = np.array([self.sent(k) for k in range(first, last + 1)])
        chambers, before = self.follow(first, coming)
        held = chambers.differential[before:].reshape(-1, self._inputs)
        return held[steps - first * STEPS]

    def surprise(self, time: Array) -> Array:
        """Return what the last reading shows beyond the model (n, M) [Pa], at instants after it."""
        if not self._times:
            return np.zeros((len(time), self._inputs))
        last = self._times[-1]
        step = np.array([int(np.floor(last / STEP - 0.5))])
        pair = self.model(np.append(step, step + 1))
        share = last / STEP - 0.5 - float(step[0])
        gap = self._readings[-1] - ((1 - share) * pair[0] + share * pair[1])
        faded: Array = np.exp(-(time - last) / _SURPRISE_TIME)[:, None] * gap
        return faded
