"""What is done about a touch: warn, hold, yield or vent.

Against what touches, the tip stays behind whatever is corrected. From before a touch is sure,
`yield` leaves corrections what they were; once it has ended they come back slowly.

A touch is worth an effective pressure ℓ per segment (`Touch.pressure`): bending further against it
raises the force. A change δu of the pressures in the chambers does so as far as −ℓ·δu > 0. While
something is touched, `yield` gives no command u with −ℓ·u above that of the plan: what is wanted is
moved to the nearest command on that side. To retreat farther than the plan would do harm where a
touch is false. With a limit in N the bound is where the force, with its deviation, would reach it:
against something that does not move, pressures raise the force at a place with compliance C_p by
−f̂ᵀ (∂p/∂u) δu / (f̂ᵀ C_p f̂).
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np

from der_planner.arrays import Array
from der_planner.control.touch import Touch
from der_planner.model import CONTROL_PERIOD, RodModel
from der_planner.model.compliance import compliance

Kind = Literal["warn", "hold", "yield", "vent"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_SUSPECTED = 0.6
"""`Touch.distance` from which on corrections stay what they were."""
_RETURN = 1.0
"""Time in which corrections come back once a touch has ended [s]."""
_SMALLEST = 1e-9
"""A pressure below this gives no direction [Pa]."""


class Reaction:
    """Keeps commands from raising the force of a touch; see the module.

    Args:
        model: rod of the limb.
        kind: one of `KINDS`. `vent` holds, and says with `vents` that the limb is to be vented.
        limit: force that is allowed [N]; None: that of the plan.

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
        self._bound = np.zeros(0), 0.0
        self._suspected = False
        self._free, self._kept = 1.0, np.zeros(model.inputs)

    @property
    def acts(self) -> bool:
        """Whether it may change commands."""
        return self.kind != "warn"

    @property
    def vents(self) -> bool:
        """Whether the limb is to be vented."""
        return self.kind == "vent" and self._held is not None

    def follow(self, planned: Array, touch: Touch, chambers: Array) -> None:
        """Look at a touch, or that there is none, before a command is asked for.

        Args:
            planned: (M,) the plan's own command [Pa].
            touch: as it is known now.
            chambers: (M,) differential pressures in them now [Pa].
        """
        self._suspected = self.acts and touch.distance > _SUSPECTED and not touch.weighed
        if touch.weighed or not (touch.touched and self.acts):
            self._held = None
            return
        if self._held is None:
            self._held = chambers
        if self.kind != "yield":
            return
        harder = -touch.pressure / max(float(np.linalg.norm(touch.pressure)), _SMALLEST)
        self._bound = harder, float(harder @ planned)
        if self.limit is not None and np.isfinite([touch.place, *touch.force]).all():
            self._bound = self._limited(touch, chambers, self.limit)

    def corrected(self, wanted: Array) -> Array:
        """Return the correction (M,) [Pa] of this control period in place of a wanted one."""
        if self._held is not None or self._suspected:
            self._free = 0.0
        else:
            self._free = min(1.0, self._free + CONTROL_PERIOD / _RETURN)
            self._kept = wanted if self._free == 1.0 else self._kept
        return self.mixed(wanted)

    def allowed(self, wanted: Array) -> Array:
        """Return the command (M,) [Pa] in place of a wanted one."""
        if self._held is None:
            return wanted
        if self.kind != "yield":
            return self._held
        harder, bound = self._bound
        square = max(float(harder @ harder), _SMALLEST**2)
        return wanted - harder * (max(0.0, float(harder @ wanted) - bound) / square)

    def mixed(self, wanted: Array) -> Array:
        """Return wanted corrections (…, M) [Pa] as far as they have come back after a touch."""
        return self._kept + self._free * (wanted - self._kept)

    def _limited(self, touch: Touch, chambers: Array, limit: float) -> tuple[Array, float]:
        """Return how pressures raise the force (M,) [N/Pa], and how far that may go [N]."""
        limp = compliance(self._model, touch.bend_angles, [touch.place])
        size = float(np.linalg.norm(touch.force))
        along = touch.force / size
        slack = float(along @ limp.place[0] @ along)
        harder = -(along @ limp.place_by_pressure[0]) / slack
        # The force may be larger than told by its standard deviation.
        most = size + math.sqrt(float(along @ touch.force_covariance @ along))
        return harder, float(harder @ chambers) + limit - most
