"""Hoses in the wrong ports: which chamber each valve of a twin fills, and which way that bends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.twin.body import TwinError


@dataclass(frozen=True)
class Wiring:
    """Which chamber each valve fills.

    Attributes:
        chambers: (2M,) for each valve the chamber that it fills, counted from 1: 1, 2 of the first
            segment, then of the next; with a minus sign, that chamber bends its segment the other
            way.

    Raises:
        TwinError: a chamber is filled by no valve or by two.
    """

    chambers: tuple[int, ...]

    def __post_init__(self) -> None:
        count = len(self.chambers)
        if sorted(map(abs, self.chambers)) != list(range(1, count + 1)) or count % 2:
            raise TwinError(
                f"wiring {list(self.chambers)}: name each of the chambers 1 to {count} once, with "
                "a minus sign where it bends the other way"
            )

    @property
    def moves(self) -> tuple[tuple[int, int], ...]:
        """(2M,) of each valve the segment that it bends, counted from 0, and to which side: ±1."""
        return tuple(
            ((abs(k) - 1) // 2, (1 if k > 0 else -1) * (1 if abs(k) % 2 else -1))
            for k in self.chambers
        )

    def felt(self, pressure: Sequence[float] | Array, atmosphere: float) -> Array:
        """Return the chamber pressures (2M,) of a well wired limb that bends as this one does.

        Args:
            pressure: (2M,) behind the valves, absolute [Pa].
            atmosphere: absolute [Pa].
        """
        felt = np.full(len(self.chambers), atmosphere)
        for value, (segment, side) in zip(pressure, self.moves, strict=True):
            felt[2 * segment + (side < 0)] += value - atmosphere
        return felt
