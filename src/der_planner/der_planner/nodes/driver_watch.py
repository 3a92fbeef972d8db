"""What the planner knows of the driver from `pressure_state`: does it take setpoints, or vent?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from der_msgs.msg import PressureState

_NAMES = {
    PressureState.DISARMED: "DISARMED",
    PressureState.ARMED: "ARMED",
    PressureState.TRACKING: "TRACKING",
    PressureState.HOLDING: "HOLDING",
    PressureState.VENTING: "VENTING",
    PressureState.FAULT: "FAULT",
}
_REMEDY = "arm the driver, then play the plan again"


@dataclass(frozen=True)
class Ending:
    """Why nothing may be streamed to the driver now.

    Attributes:
        outcome: vented, fault or lost: as in `der_msgs/action/PlayMotion`.
        reason: a sentence with the remedy.
    """

    outcome: str
    reason: str


class DriverWatch:
    """Keeps the driver's newest state; its methods may be called from any thread.

    A planner that has never heard a driver streams: the listener may be one that tells nothing of
    itself. From the first `pressure_state` on, a driver that is silent, disarmed or in fault gets
    nothing.

    Args:
        steady: returns the present time of a steady clock [s].
        timeout: [s] after which a driver that says nothing counts as dead.
    """

    def __init__(self, steady: Callable[[], float], timeout: float) -> None:
        self._steady = steady
        self._timeout = timeout
        self._changed = threading.Condition()
        self._mode: int | None = None
        self._faults: list[str] = []
        self._heard = 0.0
        self._latched = False

    @property
    def mode(self) -> str:
        """Name of the driver's newest mode; empty before the first."""
        with self._changed:
            return "" if self._mode is None else _NAMES.get(self._mode, str(self._mode))

    def take(self, state: PressureState, waiting: bool, begun: Sequence[str]) -> Ending | None:
        """Take a new state.

        Args:
            state: from the driver.
            waiting: whether a plan is being played, or waits for its start.
            begun: ids of the plans whose first setpoint is due already.

        Returns:
            Why they must be stopped, or None. The driver vents by itself only after HOLDING; a ramp
            down at the end of an earlier plan does not concern the next one.
        """
        with self._changed:
            before, self._mode = self._mode, int(state.mode)
            self._faults, self._heard = list(state.faults), self._steady()
            begins = self._mode == PressureState.VENTING and before != self._mode
            if begins:
                self._latched = before != PressureState.HOLDING
            self._changed.notify_all()
        if not waiting:
            return None
        if begins and state.plan_id in begun:
            return Ending("vented", f"the driver vents the limb: {_REMEDY}")
        if begins and before in (PressureState.ARMED, PressureState.TRACKING):
            return Ending("vented", f"the driver was told to vent: {_REMEDY}")
        return self.obstacle() if self._mode in _STOPPED else None

    def obstacle(self) -> Ending | None:
        """Return why the driver takes no setpoints now; None if it does, or was never heard."""
        with self._changed:
            if self._mode is None:
                return None
            age = self._steady() - self._heard
            if age > self._timeout:
                return Ending(
                    "lost",
                    f"the driver has said nothing for {age:.1f} s: see whether it runs and the "
                    f"limb is vented, then {_REMEDY}",
                )
            if self._mode == PressureState.FAULT:
                faults = "; ".join(self._faults) or "no reason given"
                return Ending("fault", f"the driver is in FAULT ({faults}): remove the cause, "
                              f"{_REMEDY}")  # fmt: skip
            if self._mode == PressureState.DISARMED:
                return Ending("vented", f"the driver is DISARMED: {_REMEDY}")
            if self._mode == PressureState.VENTING and self._latched:
                return Ending("vented", f"the driver is VENTING: wait, {_REMEDY}")
        return None

    def wait(self, seconds: float) -> Ending | None:
        """Wait until the driver takes setpoints, at most so long [s]; return what forbids it."""
        end = self._steady() + seconds
        with self._changed:
            while (found := self.obstacle()) is not None and (left := end - self._steady()) > 0:
                self._changed.wait(left)
        return found


_STOPPED = (PressureState.DISARMED, PressureState.FAULT)
