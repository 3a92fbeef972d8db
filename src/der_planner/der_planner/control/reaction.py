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

With a limit in N pressures go back slowly from where they are at the touch until its force can be
told: it may be beyond the limit. They do not move along the obstacle, since its direction is not
known well either. From then on the bound moves slowly to where the force f, with two deviations,
would reach the limit: a change −ℓ·δu is taken to raise the force by |f|/|ℓ|² of it. Pressures go
back no farther than to vented chambers, beyond which the limb would be led away for nothing. Once
nothing is touched, the bound moves on slowly until the plan is behind it, and slower still while a
touch is suspected.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple, get_args

import numpy as np

from der_planner.arrays import Array
from der_planner.estimation.force import Touch
from der_planner.model import CONTROL_PERIOD, RodModel

Kind = Literal["warn", "hold", "yield", "vent"]
KINDS: tuple[Kind, ...] = get_args(Kind)
_RETURN = 4.0
"""Time in which corrections come back once a touch has ended [s]."""
_SMALLEST = 1e-9
"""A pressure below this gives no direction [Pa]."""
_TOWARDS = 0.25
"""Share of the way to the limit that chambers are asked for at once: forces are told late."""
_SPEED = 1500.0
"""Speed of the bound where the force cannot be told, and where nothing is touched any more [Pa/s].
"""


class _Bound(NamedTuple):
    """How far commands may go.

    Attributes:
        held: (M,) pressures [Pa].
        harder: (M,) direction from them, of length 1, that presses harder.
        slides: whether pressures across it may change.
    """

    held: Array
    harder: Array
    slides: bool


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
        self.vents, self._acts = False, kind != "warn"
        self._bound: _Bound | None = None
        self._free, self._kept = 1.0, np.zeros(model.inputs)
        self._newest, self._suspected = self._kept, False

    def follow(self, planned: Array, touch: Touch, chambers: Array) -> None:
        """Look at a touch, or that there is none, before a command is asked for.

        Args:
            planned: (M,) the plan's own command [Pa].
            touch: as it is known now.
            chambers: (M,) differential pressures in them now [Pa].
        """
        self._suspected = touch.suspected and self._acts
        self.vents = self.kind == "vent" and touch.touched and touch.time > touch.since
        if touch.touched and self._acts:
            self._bound = self._bound_of(planned, touch, chambers)
        elif self._bound is not None:
            self._bound = self._bound_after(self._bound, planned)

    def _bound_of(self, planned: Array, touch: Touch, chambers: Array) -> _Bound:
        """Return the bound while something is touched; arguments as of `follow`."""
        length = max(float(np.linalg.norm(touch.pressure)), _SMALLEST)
        harder: Array = -touch.pressure / length
        if self.kind == "yield" and self.limit is None:
            return _Bound(planned, harder, True)
        size = float(np.linalg.norm(touch.force))
        if self.limit is None or not size > 0.0:
            bound = self._bound or _Bound(chambers, harder, False)
            most = 0.0 if self.limit is None else float(bound.harder @ bound.held)
            back = max(0.0, min(most, _SPEED * CONTROL_PERIOD))
            return bound._replace(held=bound.held - back * bound.harder, slides=False)
        along = touch.force / size
        # Friction bears a part of the force: it may be larger by two standard deviations.
        most = size + 2.0 * math.sqrt(float(along @ touch.force_covariance @ along))
        step = _TOWARDS * (self.limit - most) * length / size
        return _Bound(chambers + step * harder, harder, True)

    def _bound_after(self, bound: _Bound, planned: Array) -> _Bound | None:
        """Return what is left of a bound once nothing is touched."""
        held, harder, _ = bound
        # Friction may hide a touch that goes on.
        if self.limit is None:
            hidden = self.kind == "yield" and self._suspected
            return _Bound(planned, harder, True) if hidden else None
        speed = _SPEED / 3.0 if self._suspected else _SPEED
        behind = harder @ (planned - held) <= 0.0
        return None if behind else bound._replace(held=held + speed * CONTROL_PERIOD * harder)

    def corrected(self, wanted: Array) -> Array:
        """Return the correction (M,) [Pa] of this control period in place of a wanted one."""
        if self._bound is None:
            self._free = min(1.0, self._free + CONTROL_PERIOD / _RETURN)
        elif self._free > 0.0:
            self._free, self._kept = 0.0, self._newest
        self._newest = self.mixed(wanted)
        return self._newest

    def allowed(self, wanted: Array) -> Array:
        """Return the command (M,) [Pa] in place of a wanted one; from any thread."""
        if self._bound is None:
            return wanted
        held, harder, slides = self._bound
        if self.kind != "yield":
            return held
        further = float(harder @ (wanted - held))
        return wanted - max(0.0, further) * harder if slides else held + min(0.0, further) * harder

    def mixed(self, wanted: Array) -> Array:
        """Return wanted corrections (…, M) [Pa] as far as they have come back after a touch.

        While one is suspected they are between none and what was sent last.
        """
        back: Array = self._kept + self._free * (wanted - self._kept)
        if self._suspected and self._bound is None:
            back = np.clip(back, np.minimum(self._newest, 0.0), np.maximum(self._newest, 0.0))
        return back
