"""The air of an emulated valve board: regulators, valves, tubes and chambers, without a clock.

Each chamber has a proportional regulator. Filling is limited by the inlet valve (a ramp), venting
by the outlet orifice (slower the less pressure is left, reaching zero in finite time), and a
chamber feels what its neighbour in the limb does, since they share a wall. The numbers agree with
logs of a real limb: 9 kPa/s filling, 2.5 s from 90 to 10 % when a step of 7 kPa is vented, a
neighbour that rises by up to a quarter of the change and is back after about a second. The limb
does this and not the board: the chambers of the other segment stay as they are, and the neighbour
falls below the room's pressure while the chamber is vented.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray: TypeAlias = NDArray[np.float64]

LARGEST_SUBSTEP = 0.005
"""[s] Longest explicit step: a sixteenth of the fastest time constant."""

VENT_EXPONENT = 2.0 / 3.0
"""Outflow grows with this power of the gauge pressure: between an orifice (1/2) and a tube (1)."""

REFERENCE_STEP = 7000.0
"""[Pa] The vented step whose 90-to-10-% time is `VENT_TIME`."""
FILL_RATE = 9000.0
"""[Pa/s] of the inlet valve, wide open, at nominal supply."""
VENT_TIME = 2.5
"""[s] from 90 to 10 % of a step of `REFERENCE_STEP`."""
REGULATOR_TIME = 0.08
"""[s] time constant of the regulator close to its target."""
DEAD_TIME = 0.03
"""[s] from a command to the first motion of a valve."""
VENT_DEADBAND = 80.0
"""[Pa] above target before the outlet valve opens."""
FILL_COUPLING = 0.45
"""Share of the rate of a filling chamber that its neighbour sees."""
VENT_COUPLING = 0.06
"""Share of the rate of a venting chamber that its neighbour sees."""
COUPLING_TIME = 0.45
"""[s] in which the neighbour's disturbance decays."""
SUPPLY_PRESSURE = 140e3
"""[Pa] absolute, of the reservoir."""
VARIATION = 0.05
"""Relative standard deviation between chambers, cut at two of them."""


class BoardPneumatics:
    """Chamber pressures of a board with one pair of chambers per segment.

    All pressures are true absolute pressures in Pa; what the board's sensors make of them is the
    board's business. The same seed gives the same limb: atmosphere, rates and couplings are drawn
    from it.

    Args:
        segment_count: M, number of segments; there are 2M chambers.
        seed: of the drawn variations.
        chambers: (2M,) chamber of the limb that each valve fills, counted from 0; None: its own.
    """

    def __init__(
        self, segment_count: int = 2, seed: int = 0, chambers: Sequence[int] | None = None
    ) -> None:
        self.chamber_count = 2 * segment_count
        generator = np.random.default_rng([seed, 0x9A1B])
        self.atmosphere = float(101_325.0 + generator.uniform(-700.0, 1500.0))
        """[Pa] absolute pressure of the room."""
        self.supply_pressure = SUPPLY_PRESSURE
        """[Pa] absolute pressure of the reservoir; may be changed while running."""
        self.stuck = np.zeros(self.chamber_count, dtype=bool)
        """(2M,) chambers whose valves have stopped moving: neither filled nor vented."""
        self.leak = np.zeros(self.chamber_count)
        """(2M,) [1/s] rate at which a hole drains the gauge pressure."""

        def vary(nominal: float) -> FloatArray:
            spread = np.clip(generator.normal(size=self.chamber_count), -2.0, 2.0)
            return nominal * (1.0 + VARIATION * spread)

        self._fill_rate = vary(FILL_RATE)
        # c of dp/dt = −c p^n from the 90-to-10-% time of a step of `REFERENCE_STEP`.
        power = 1.0 - VENT_EXPONENT
        span = (0.9**power - 0.1**power) / power
        self._vent_coefficient = REFERENCE_STEP**power * span / vary(VENT_TIME)
        self._regulator_time = vary(REGULATOR_TIME)
        self._vent_deadband = vary(VENT_DEADBAND)
        self._fill_coupling = vary(FILL_COUPLING)
        self._vent_coupling = vary(VENT_COUPLING)
        self._coupling_time = vary(COUPLING_TIME)
        self._dead_time = float(DEAD_TIME * generator.uniform(0.7, 1.3))
        filled = np.arange(self.chamber_count) if chambers is None else np.array(chambers)
        # Chambers 2k and 2k + 1 are neighbours, whatever valves fill them.
        self._neighbour = np.argsort(filled)[filled ^ 1]

        self._gauge = np.zeros(self.chamber_count)
        self._disturbance = np.zeros(self.chamber_count)
        self._target = np.zeros(self.chamber_count)
        self._pending: list[tuple[float, FloatArray]] = []
        self._time = 0.0

    @property
    def pressure(self) -> FloatArray:
        """(2M,) [Pa] absolute chamber pressures now."""
        return self.atmosphere + self._gauge + self._disturbance

    @property
    def valve_opening(self) -> FloatArray:
        """(2M,) share of the wide open flow that the inlet valves pass now, 0 … 1."""
        demand = (self._target - self._gauge) / (self._regulator_time * self._fill_rate)
        return np.where(self.stuck, 0.0, np.clip(demand, 0.0, 1.0))

    def command(self, pressure: ArrayLike) -> None:
        """Set what the regulators work toward, from one dead time later on.

        Args:
            pressure: (2M,) [Pa] absolute; below the atmosphere counts as vented.
        """
        gauge = np.maximum(np.asarray(pressure) - self.atmosphere, 0.0)
        self._pending.append((self._time + self._dead_time, gauge))

    def step(self, duration: float) -> FloatArray:
        """Let time pass.

        Args:
            duration: [s], zero or more.

        Returns:
            (2M,) [Pa] absolute chamber pressures at the end.
        """
        end = self._time + duration
        while self._time < end - 1e-12:
            while self._pending and self._pending[0][0] <= self._time + 1e-12:
                self._target = self._pending.pop(0)[1]
            until = min(end, self._pending[0][0]) if self._pending else end
            substeps = max(1, int(np.ceil((until - self._time) / LARGEST_SUBSTEP - 1e-9)))
            length = (until - self._time) / substeps
            for _ in range(substeps):
                self._advance(length)
            self._time = until
        return self.pressure

    def _advance(self, dt: float) -> None:
        """One explicit step of regulators, valves and the coupling within pairs."""
        error = self._target - self._gauge
        demand = error / self._regulator_time
        headroom = self.supply_pressure - self.atmosphere - self._gauge
        nominal_head = 0.25 * (SUPPLY_PRESSURE - self.atmosphere)
        # Three times as fast as np.clip on a few numbers.
        inflow = self._fill_rate * np.minimum(np.maximum(headroom / nominal_head, 0.0), 1.0)
        outflow = self._vent_coefficient * np.maximum(self._gauge, 0.0) ** VENT_EXPONENT
        opens = (error < -self._vent_deadband) | (self._target <= 0.0)
        rate = np.where(
            error >= 0.0,
            np.minimum(demand, inflow),
            np.where(opens, np.maximum(demand, -outflow), 0.0),
        )
        rate = np.where(self.stuck, 0.0, rate) - self.leak * self._gauge
        self._gauge = np.maximum(self._gauge + dt * rate, 0.0)
        felt = rate[self._neighbour]
        source = np.where(felt > 0.0, self._fill_coupling, self._vent_coupling) * felt
        self._disturbance += dt * (source - self._disturbance / self._coupling_time)
