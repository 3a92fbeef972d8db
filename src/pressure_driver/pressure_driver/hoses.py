"""Hoses that run crosswise: which valve of the board feeds which chamber of the limb."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from pressure_driver.protocols import Telemetry


class HoseError(ValueError):
    """The wiring cannot be played; the message says what to change."""


class Hoses:
    """Turns commands for the limb into those for the board, and back what the board tells.

    Boards fill one valve of each pair and vent the other: both chambers of a segment must hang on
    one pair, whichever it is and whichever way round.

    Args:
        wiring: of each chamber of the limb the valve that feeds it, counted from 1, as "3,4,1,2".
        segment_count: M.

    Raises:
        HoseError: a valve is missing or named twice, or a pair of chambers hangs on two pairs.
    """

    def __init__(self, wiring: str, segment_count: int) -> None:
        count = 2 * segment_count
        words = wiring.replace(",", " ").split()
        if sorted(words) != sorted(map(str, range(1, count + 1))):
            raise HoseError(
                f"wiring '{wiring}': name each of the valves 1 to {count} once, in the order of "
                "the limb's chambers"
            )
        self._valves = tuple(int(word) - 1 for word in words)
        fed = {valve: chamber for chamber, valve in enumerate(self._valves)}
        for segment in range(segment_count):
            left, right = self._valves[2 * segment], self._valves[2 * segment + 1]
            if left // 2 != right // 2:
                other = fed[left ^ 1]
                raise HoseError(
                    f"wiring '{wiring}': the chambers of segment {segment + 1} hang on valves "
                    f"{left + 1} and {right + 1}, which are no pair of the board: swap the hoses "
                    f"of valves {right + 1} and {(left ^ 1) + 1} (chambers {2 * segment + 2} and "
                    f"{other + 1} of the limb)"
                )
        self._pairs = tuple(
            (fed[2 * pair] // 2, 1.0 if fed[2 * pair] % 2 == 0 else -1.0)
            for pair in range(segment_count)
        )

    def to_board(self, differential: Sequence[float]) -> list[float]:
        """Return the differential pressure (M,) of each pair of valves [Pa]."""
        return [sign * differential[segment] for segment, sign in self._pairs]

    def from_board(self, telemetry: Telemetry) -> Telemetry:
        """Return what the board has measured in the order of the limb's chambers."""
        return replace(
            telemetry,
            chamber_pressure=self._sorted(telemetry.chamber_pressure),
            valve_opening=self._sorted(telemetry.valve_opening),
        )

    def _sorted(self, values: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if values is None or len(values) != len(self._valves):
            return values
        return tuple(values[valve] for valve in self._valves)
