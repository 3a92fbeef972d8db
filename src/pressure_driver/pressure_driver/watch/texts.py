"""How much of what a board says in words goes to the log."""

from __future__ import annotations


class LogAllowance:
    """How many texts of the board may still be logged: some at once, a few a second for ever.

    Args:
        burst: texts at once, such as those of a boot.
        rate: [1/s] of the allowance that comes back.
    """

    def __init__(self, burst: int = 30, rate: float = 3.0) -> None:
        self.withheld = 0
        """Texts that were not logged."""
        self._burst, self._rate = float(burst), rate
        self._left, self._asked_at = float(burst), 0.0

    def allows(self, now: float) -> bool:
        """Tell whether one more may be logged now (steady clock [s])."""
        self._left = min(self._burst, self._left + (now - self._asked_at) * self._rate)
        self._asked_at = now
        if self._left < 1.0:
            self.withheld += 1
            return False
        self._left -= 1.0
        return True
