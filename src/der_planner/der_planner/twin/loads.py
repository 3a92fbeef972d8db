"""What acts on the simulated limb beside its pressures: gravity, carried masses, pushes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import BEYOND_THE_TIP

Array = NDArray[np.float64]


class LoadError(ValueError):
    """A load is impossible; the message says which and why."""


@dataclass(frozen=True)
class Push:
    """A force on the limb, or a mass that is hung on it, for a while.

    Attributes:
        instant: from when on [s]; of which clock, says who takes it.
        arc_length: where, from the clamp [m].
        force: (3,) in `limb_base` [N]; its direction stays the same while the limb moves.
        mass: that hangs there meanwhile [kg]; negative for one that is taken off.
        duration: how long [s].
    """

    instant: float
    arc_length: float
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mass: float = 0.0
    duration: float = math.inf

    @property
    def end(self) -> float:
        """When it ends [s]."""
        return self.instant + self.duration if math.isfinite(self.duration) else math.inf

    def acts(self, time: float) -> bool:
        """Whether it acts at this time [s]."""
        return self.instant <= time < self.end


class NodeLoads:
    """The loads of a rod as masses and forces of its nodes.

    A load between two nodes is shared between them by the lever rule: the sum and the first
    moment are exact, and gravity does the work on the nodes that it does on the load.

    Args:
        node_arc: (E+1,) material coordinate of the nodes [m].
        mass: (E+1,) of the nodes [kg]; kept up to date in place.
        force: (3, E+1) external forces [N]; kept up to date in place.
        gravity: (3,) acceleration in `limb_base` [m/s²].

    Raises:
        LoadError: gravity is not three finite numbers.
    """

    def __init__(
        self, node_arc: Array, mass: Array, force: Array, gravity: Sequence[float]
    ) -> None:
        if len(gravity) != 3 or not np.all(np.isfinite(gravity)):
            raise LoadError(f"gravity must be three finite numbers in m/s², got {gravity}")
        self._node_arc = node_arc
        self._own_mass = mass.copy()
        self._mass = mass
        self._force = force
        self._gravity = np.array(gravity, dtype=float)
        self._pushes: list[tuple[Push, Array]] = []
        self.update(0.0)

    @property
    def any(self) -> bool:
        """Whether a force acts."""
        return bool(np.any(self._force))

    def add(self, push: Push) -> None:
        """Take a push into the schedule; `update` puts it on the nodes when it is time.

        Raises:
            LoadError: the place is not on the limb, a number is not finite, or more mass is taken
                off than there is.
        """
        if not np.all(np.isfinite([*push.force, push.mass])) or len(push.force) != 3:
            raise LoadError(f"force and mass of a push must be finite, got {push}")
        if math.isnan(push.instant) or not push.duration > 0:
            raise LoadError(f"a push needs an instant and a duration above 0 s, got {push}")
        shares = self._shares(push.arc_length)
        total = self._own_mass + push.mass * shares
        for other, other_shares in self._pushes:
            total = total + other.mass * other_shares
        if np.any(total <= 0.0):
            raise LoadError(f"there is no mass of {-push.mass} kg at {push.arc_length} m to take")
        self._pushes.append((push, shares))

    def next_change(self, time: float) -> float:
        """Return when the next push begins or ends after a time [s]; infinite for never."""
        instants = [
            instant
            for push, _ in self._pushes
            for instant in (push.instant, push.end)
            if instant > time
        ]
        return min(instants, default=math.inf)

    def update(self, time: float) -> None:
        """Put what acts at a time [s] on the nodes."""
        acting = [(push, shares) for push, shares in self._pushes if push.acts(time)]
        self._mass[:] = self._own_mass
        for push, shares in acting:
            self._mass += push.mass * shares
        self._force[:] = self._gravity[:, None] * self._mass
        for push, shares in acting:
            self._force += np.array(push.force)[:, None] * shares

    def _shares(self, arc_length: float) -> Array:
        """Return what each node (E+1,) bears of a load at an arc length [m]."""
        end = float(self._node_arc[-1])
        if not -1e-9 <= arc_length <= end + BEYOND_THE_TIP:
            raise LoadError(
                f"a load at {arc_length} m is not on the limb: its arc length is 0 to {end:.3f} m"
            )
        place = min(max(arc_length, 0.0), end)
        index = int(np.clip(np.searchsorted(self._node_arc, place) - 1, 0, len(self._node_arc) - 2))
        before, after = self._node_arc[index : index + 2]
        share = (place - before) / (after - before)
        shares = np.zeros(len(self._node_arc))
        shares[index : index + 2] = 1.0 - share, share
        return shares
