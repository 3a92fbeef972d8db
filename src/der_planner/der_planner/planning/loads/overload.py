"""Whether a loaded limb stays at the poses of a motion, and whether pressure can hold it there."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import PAYLOAD, Limb
from der_planner.planning.errors import BucklingError, OverloadError, PlanningError
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]

_HALVINGS = 8


def check_load(
    limb: Limb, time: Array, tip: Array, pressure: Array, needed: Callable[[Limb], Array]
) -> None:
    """Refuse a motion along which resting takes more pressure than the limb may have.

    Args:
        limb: as the model sees it.
        time: (K,) [s].
        tip: (K, 2) of the motion [m].
        pressure: (K, M) differential pressures that hold the limb at rest at these instants [Pa].
        needed: returns the same for a limb that carries less.

    Raises:
        OverloadError: with what is needed, when and where, and what could be carried.
    """
    limit = limb.pneumatics.pressure_limit
    if np.abs(pressure).max() <= limit:
        return
    k, segment = np.unravel_index(int(np.abs(pressure).argmax()), pressure.shape)
    carried, possible = 0.0, None
    if limb.masses:
        named = [mass.mass for mass in limb.masses if mass.name == PAYLOAD]
        carried = sum(named) if named else sum(mass.mass for mass in limb.masses)
        share = _possible_share(limb, needed)
        possible = None if share is None else share * carried
    raise OverloadError(
        float(time[k]), (float(tip[k, 0]), float(tip[k, 1])), int(segment),
        float(np.abs(pressure[k, segment])), limit, carried, possible,
    )  # fmt: skip


def check_stays(stiffness: Array, time: Array, tip: Array, what: str) -> None:
    """Refuse a motion with a pose from which the limb would snap through.

    Args:
        stiffness: (K,) smallest eigenvalue of the static stiffness at each pose.
        time: (K,) [s].
        tip: (K, 2) of the poses [m].
        what: "limb" or "arcs", for the message.

    Raises:
        BucklingError: names the first such pose.
    """
    falls = stiffness <= 0
    if falls.any():
        k = int(np.argmax(falls))
        raise BucklingError(
            f"the {what} would snap through under the load at t = {time[k]:.2f} s, tip at "
            f"({tip[k, 0]:.4f}, {tip[k, 1]:.4f}) m. Shrink or move the motion, or mount the limb "
            "otherwise"
        )


def _possible_share(limb: Limb, needed: Callable[[Limb], Array]) -> float | None:
    """Return the share of its masses that the limb can hold; None: not even its own weight."""

    def holds(share: float) -> bool:
        try:
            pressure = needed(_with_share(limb, share))
        except (ConvergenceError, PlanningError, ValueError):
            return False
        return bool(np.abs(pressure).max() <= limb.pneumatics.pressure_limit)

    if not holds(0.0):
        return None
    low, high = 0.0, 1.0
    for _ in range(_HALVINGS):
        share = 0.5 * (low + high)
        low, high = (share, high) if holds(share) else (low, share)
    return low


def _with_share(limb: Limb, share: float) -> Limb:
    """Return the limb with a share of its payload; without a payload: of all that it carries."""
    every = all(mass.name != PAYLOAD for mass in limb.masses)
    masses = tuple(
        dataclasses.replace(mass, mass=share * mass.mass) if every or mass.name == PAYLOAD else mass
        for mass in limb.masses
    )
    return dataclasses.replace(limb, masses=masses)
