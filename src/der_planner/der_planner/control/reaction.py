"""What is done about a touch: warn, hold, yield or vent.

A touch is worth an effective pressure ℓ per segment (`Touch.pressure`): bending further against it
raises the force. A change δu of the pressures in the chambers does so as far as −ℓ·δu > 0. While
something is touched, `yield` gives no command u with −ℓ·u above the least that the chambers have
held since: what the plan and its corrections want is moved to the nearest command on that side. The
limb retreats as the plan does, does not follow when the plan presses again, and is free once the
touch has ended. With a limit in N the bound is where the force would reach it: against something
that does not move, pressures raise the force at a place with compliance C_p by
−f̂ᵀ (∂p/∂u) δu / (f̂ᵀ C_p f̂).
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np

from der_planner.arrays import Array
from der_planner.control.touch import Touch
from der_planner.model import RodModel
from der_planner.model.compliance import compliance

Kind = Literal["warn", "hold", "yield", "vent"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_SMALLEST = 1e-9
"""A pressure below this gives no direction [Pa]."""


class Reaction:
    """Keeps commands from raising the force of a touch; see the module.

    Args:
        model: rod of the limb.
        kind: one of `KINDS`. `vent` holds, and says with `vents` that the limb is to be vented.
        limit: force that is allowed [N]; None: none more than there is.

    Raises:
        ValueError: another kind, or a limit that is no force.
    """

    def __init__(self, model: RodModel, kind: Kind = "yield", limit: float | None = None) -> None:
        if kind not in KINDS:
            raise ValueError(f"a reaction is one of {', '.join(KINDS)}, got {kind!r}")
        if limit is not None and not (math.isfinite(limit) and limit >= 0.0):
            raise ValueError(f"a limit of the force must be 0 N or more, got {limit}")
        self.kind, self.limit = kind, limit
        self._model = model
        self._held: Array | None = None

    @property
    def acts(self) -> bool:
        """Whether it changes commands."""
        return self.kind != "warn"

    def release(self) -> None:
        """Forget the touch: it has ended."""
        self._held = None

    @property
    def vents(self) -> bool:
        """Whether the limb is to be vented."""
        return self.kind == "vent" and self._held is not None

    def allowed(self, wanted: Array, touch: Touch, bend_angles: Array, chambers: Array) -> Array:
        """Return the command (M,) [Pa] in place of a wanted one.

        Args:
            wanted: (M,) [Pa].
            touch: as it is known now, of a limb that is touched.
            bend_angles: (M,) [rad].
            chambers: (M,) differential pressures in them now [Pa].
        """
        if not self.acts:
            return wanted
        if self._held is None:
            self._held = chambers
        if self.kind != "yield":
            return self._held
        harder = -touch.pressure / max(float(np.linalg.norm(touch.pressure)), _SMALLEST)
        if harder @ chambers < harder @ self._held:
            self._held = chambers
        bound = float(harder @ self._held)
        if self.limit is not None and np.isfinite([touch.place, *touch.force]).all():
            harder, bound = self._limited(touch, bend_angles, chambers, self.limit)
        square = float(harder @ harder)
        if square < _SMALLEST**2:
            return wanted
        return wanted - harder * (max(0.0, float(harder @ wanted) - bound) / square)

    def _limited(
        self, touch: Touch, bend_angles: Array, chambers: Array, limit: float
    ) -> tuple[Array, float]:
        """Return how pressures raise the force (M,) [N/Pa], and how far that may go [N]."""
        limp = compliance(self._model, bend_angles, [touch.place])
        size = float(np.linalg.norm(touch.force))
        along = touch.force / size
        slack = float(along @ limp.place[0] @ along)
        harder = -(along @ limp.place_by_pressure[0]) / slack
        return harder, float(harder @ chambers) + limit - size
