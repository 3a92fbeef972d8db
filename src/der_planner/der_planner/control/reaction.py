"""What is done about a touch: warn, hold, yield or vent.

Against what touches, the tip stays behind whatever is corrected: corrections stay what they were,
and come back slowly once the touch has ended, since the plan may press on what the limb has left.
Where a touch is only suspected, they may shrink but not grow: friction hides a light touch for
seconds, in which corrections pressed twice as hard as the plan.

A touch is worth an effective pressure ℓ per segment (`Touch.pressure`): bending further against it
raises the force. A change δu of the pressures in the chambers does so as far as −ℓ·δu > 0. While
something is touched, `yield` gives no command u with −ℓ·u above that of the plan: what is wanted is
moved to the nearest command on that side, until nothing is suspected any more. To retreat farther
than the plan would do harm where a touch is false.

With a limit in N the bound is where the force f, with two deviations, would reach it: a change
−ℓ·δu is taken to raise the force by |f|/|ℓ|² of it. Until the force can be told, pressures stay
where the plan had them at the touch. A touch ends once the limb has gone back; the bound stays
until the plan itself has gone back behind it.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np

from der_planner.arrays import Array
from der_planner.control.force import Touch
from der_planner.model import CONTROL_PERIOD, RodModel

Kind = Literal["warn", "hold", "yield", "vent"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_RETURN = 4.0
"""Time in which corrections come back once a touch has ended [s]."""
_SMALLEST = 1e-9
"""A pressure below this gives no direction [Pa]."""


class Reaction:
    """Keeps commands from raising the force of a touch; see the module.

    Args:
        model: rod of the limb.
        kind: one of `KINDS`. `vent` holds, and says with `vents` that the limb is to be vented.
        limit: force that is allowed [N]; None: that of the plan.

    Attributes:
        vents: whether the limb is to be vented: one picture alone does not tell that.

    Raises:
        ValueError: another kind, or a limit that is no force.
    """

    def __init__(self, model: RodModel, kind: Kind = "yield", limit: float | None = None) -> None:
        if kind not in KINDS:
            raise ValueError(f"a reaction is one of {', '.join(KINDS)}, got {kind!r}")
        if limit is not None and not (math.isfinite(limit) and limit >= 0.0 and kind == "yield"):
            raise ValueError(
                f"a limit of the force must be 0 N or more, with the reaction yield, got {limit} "
                f"with {kind}"
            )
        self.kind, self.limit = kind, limit
        self.vents = False
        self._held: Array | None = None
        self._bound = np.zeros(model.inputs), 0.0
        self._free, self._kept = 1.0, np.zeros(model.inputs)
        self._newest, self._suspected = self._kept, False

    @property
    def acts(self) -> bool:
        """Whether it may change commands."""
        return self.kind != "warn"

    def follow(self, planned: Array, touch: Touch, chambers: Array) -> None:
        """Look at a touch, or that there is none, before a command is asked for.

        Args:
            planned: (M,) the plan's own command [Pa].
            touch: as it is known now.
            chambers: (M,) differential pressures in them now [Pa].
        """
        harder, bound = self._bound
        self._suspected = touch.suspected and self.acts
        self.vents = self.kind == "vent" and touch.touched and touch.time > touch.since
        if not (touch.touched and self.acts):
            yields = self.kind == "yield" and self._held is not None
            if yields and self.limit is None and touch.suspected:
                self._bound = harder, float(harder @ planned)
            elif not (yields and self.limit is not None and harder @ planned > bound):
                self._held = None
            return
        begins = self._held is None
        if self._held is None:
            self._held = chambers
        if self.kind != "yield":
            return
        square = max(float(touch.pressure @ touch.pressure), _SMALLEST**2)
        size = float(np.linalg.norm(touch.force))
        if self.limit is not None and size > 0.0:
            along = touch.force / size
            # Friction bears a part of the force: it may be larger by two standard deviations.
            most = size + 2.0 * math.sqrt(float(along @ touch.force_covariance @ along))
            harder = -size / square * touch.pressure
            self._bound = harder, float(harder @ chambers) + self.limit - most
        elif self.limit is None or begins:
            harder = -touch.pressure / math.sqrt(square)
            self._bound = harder, float(harder @ planned)

    def corrected(self, wanted: Array) -> Array:
        """Return the correction (M,) [Pa] of this control period in place of a wanted one."""
        if self._held is None:
            self._free = min(1.0, self._free + CONTROL_PERIOD / _RETURN)
        elif self._free > 0.0:
            self._free, self._kept = 0.0, self._newest
        self._newest = self.mixed(wanted)
        return self._newest

    def allowed(self, wanted: Array) -> Array:
        """Return the command (M,) [Pa] in place of a wanted one; from any thread."""
        held = self._held
        if held is None:
            return wanted
        if self.kind != "yield":
            return held
        harder, bound = self._bound
        square = max(float(harder @ harder), _SMALLEST**2)
        return wanted - harder * (max(0.0, float(harder @ wanted) - bound) / square)

    def mixed(self, wanted: Array) -> Array:
        """Return wanted corrections (…, M) [Pa] as far as they have come back after a touch.

        While one is suspected they are between none and what was sent last.
        """
        back: Array = self._kept + self._free * (wanted - self._kept)
        if self._suspected and self._held is None:
            back = np.clip(back, np.minimum(self._newest, 0.0), np.maximum(self._newest, 0.0))
        return back
