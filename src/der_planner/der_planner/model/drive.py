"""From commands to effective pressures along a known bend, window by window of a long motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.model import air, material
from der_planner.model.series import CONTROL_PERIOD, step_middles

Array = NDArray[np.float64]
Bend = Callable[[Array], Array]
"""Bend angles (K, M) [rad] at instants (K,) [s]."""

STEPS = 5
"""Integrator steps in a control period: 10 ms."""


@dataclass(frozen=True)
class Window:
    """Effective pressures under W commands in a row, the first of which has the index `first`.

    Attributes:
        limb: of the pressures.
        first: index of the first command of the window.
        chambers: what the chambers do under the commands from index ``begin`` on.
        begin: index of the first command that the chambers were given.
        effective: (W, S, M) effective pressure of each integrator step [Pa].
    """

    limb: Limb
    first: int
    chambers: air.Chambers
    begin: int
    effective: Array

    @property
    def differential(self) -> Array:
        """(W, S, M) pressure in the chambers amid each integrator step [Pa]."""
        return self.chambers.differential[self.first - self.begin :]

    @cached_property
    def slopes(self) -> material.Slopes:
        """∂(effective)/∂(differential) of each step, at a known bend."""
        return material.slopes(self.limb, self.differential, self.effective)

    def by_command(self) -> Array:
        """Return ∂(differential pressure of a step)/∂command (W, S, W, M) within the window."""
        return air.derivative(self.chambers, self.first - self.begin)


class Drive:
    """From K commands to the effective pressures of a limb, window by window.

    Friction and creep act along a known bend, so that what they take is computed once; the chambers
    are followed from as far back as they can remember.

    Args:
        limb: calibrated limb.
        bend: of the motion.
        count: K.
        steps: S, integrator steps a command.
        before: (M,) command before the first one [Pa].
        memory: of friction and creep at the first command; None: rested.
        period: of a command [s].
    """

    def __init__(
        self,
        limb: Limb,
        bend: Bend,
        count: int,
        steps: int,
        before: Array,
        memory: material.Memory | None = None,
        period: float = CONTROL_PERIOD,
    ) -> None:
        self.limb, self.steps, self.before, self.period = limb, steps, before, period
        self._remembered = int(np.ceil(air.memory_of(limb.pneumatics) / period))
        middle = step_middles(count, steps, period)
        self._history = material.remember(limb, middle, bend(middle), memory)
        self._taken = material.taken_by(limb, self._history).reshape(count, steps, -1)

    def window(self, command: Array, first: int = 0) -> Window:
        """Return what the limb feels from command ``first`` on.

        Args:
            command: (first + W, M) commands from the beginning [Pa].
            first: of the window.
        """
        begin = max(0, first - self._remembered)
        before = command[begin - 1] if begin else self.before
        chambers = air.follow_commands(
            self.limb.pneumatics, command[begin:], self.period, self.steps, before
        )
        held = chambers.differential[first - begin :]
        taken = self._taken[first : len(command)]
        effective = material.without_memory(self.limb, held, taken)
        return Window(self.limb, first, chambers, begin, effective)

    def memory(self) -> material.Memory:
        """Return what friction and creep remember amid the last integrator step."""
        return self._history.at(-1)
