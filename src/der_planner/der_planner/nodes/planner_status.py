"""What the planner says of itself: its state, the plan that it is about, why, and how far."""

from __future__ import annotations

import threading

from der_planner.planning import Plan
from limb_interfaces.diagnostics import Health

_LEVELS = {
    "starting": "stale",
    "error": "error",
    "failed": "error",
    "fault": "error",
    "lost": "error",
    "refused": "warning",
    "vented": "warning",
}


class PlannerStatus:
    """The node's state, which several threads set and read.

    States: starting, idle, planning, streaming, done, refused, error, and the outcomes of a plan
    that the driver ended (vented, fault, lost).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._state, self._plan_id, self._reason = "starting", "", ""
        self._last_refusal = ""
        self.progress = 0.0
        """Share of the planning or of the playing that is done, 0 to 1."""

    def set(
        self,
        state: str,
        plan_id: str | None = None,
        reason: str = "",
        progress: float | None = None,
    ) -> None:
        """Change the state; None keeps the plan or the progress as it is."""
        with self._lock:
            self._state, self._reason = state, reason
            self._plan_id = self._plan_id if plan_id is None else plan_id
            self.progress = self.progress if progress is None else progress

    def ready(self) -> None:
        """Go from starting to idle, unless a command came meanwhile."""
        with self._lock:
            if self._state == "starting":
                self._state = "idle"

    def refused(self, text: str) -> None:
        """Remember why the last request was refused; "" once one is accepted."""
        with self._lock:
            self._last_refusal = text

    def read(self) -> tuple[str, str, float]:
        """Return the plan's id, the state and the progress."""
        with self._lock:
            return self._plan_id, self._state, self.progress

    def health(self, newest: Plan | None, values: dict[str, str]) -> Health:
        """Return the diagnostics: these and ``values``, and figures of the newest plan."""
        with self._lock:
            state, reason, refusal = self._state, self._reason, self._last_refusal
            values = {
                "state": state,
                "plan_id": self._plan_id,
                "reason": reason,
                "last_refusal": refusal,
                "progress": f"{self.progress:.3f}",
                **values,
            }
        if newest is not None:
            values["predicted_error_m"] = f"{newest.predicted_error:.6f}"
            values["pressure_margin_pa"] = f"{newest.pressure_margin:.0f}"
            values["slew_margin_pa_per_s"] = f"{newest.slew_margin:.0f}"
            values["solve_time_s"] = f"{newest.solve_time:.3f}"
        if state == "starting":
            return Health("stale", "waiting for the models to compile", values)
        if state in _LEVELS:
            return Health(_LEVELS[state], f"{state}: {reason}", values)
        if refusal:
            return Health("warning", f"{state}; refused {refusal}", values)
        level = "warning" if state == "streaming" and reason else "ok"
        return Health(level, reason or state, values)
