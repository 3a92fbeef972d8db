"""What loads a limb beside its pressures: gravity as it is mounted, and the masses that it carries.

A mounting is named by how the straight limb lies in the plane of motion, and how that plane stands:

    horizontal  the plane is level and a plate or air carries the limb: no gravity in the plane
    hanging     the limb hangs from its clamp: gravity along +x
    standing    it stands on its clamp: gravity along −x
    sideways    it leaves a wall: gravity along −y
    DEG         a level limb on its plate, tilted by so many degrees about its straight axis x, so
                that its left side comes up: g sin(DEG) along −y. 0 is horizontal, 90 sideways.

Gravity across the plane is taken for carried by the plate. A limb that is free to sag out of its
plane is given its gravity itself: `gravity: [0, 0, -9.81]` in the limb file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from der_planner.limb.declaration import LimbError, parameter

GRAVITY = 9.81
"""Of the earth [m/s²]."""
_SAME_GRAVITY = 1e-6
_ROUNDING = 1e-12
HEAVIEST = 10.0
"""Largest mass of a limb, or of its payload [kg]: more is a mistake in the unit."""
PAYLOAD = "payload"
"""Name of the mass that only one run carries."""
BEYOND_THE_TIP = 5e-3
"""Distance beyond the tip [m] up to which a payload is taken to be on the tip."""
MOST_TILT = 180.0
"""Of a plate about the straight limb, either way [degrees]."""
MOUNTINGS = {
    "horizontal": (0.0, 0.0, 0.0),
    "hanging": (GRAVITY, 0.0, 0.0),
    "standing": (-GRAVITY, 0.0, 0.0),
    "sideways": (0.0, -GRAVITY, 0.0),
}
"""Gravity in `limb_base` [m/s²] by the name of a mounting."""


@dataclass(frozen=True)
class PointMass:
    """A mass that a limb carries at one place of its centreline, beside its distributed mass.

    It has weight and inertia, no stiffness and no damping of its own. What hangs on the limb's
    stiff base or its clamp does not move and has no effect.
    """

    arc_length: float = parameter(
        "m",
        "distance from the clamp along the limb",
        "measure along the straight limb; the tip is at the sum of all lengths",
        interval="[0, inf)",
    )
    mass: float = parameter(
        "kg",
        "what the limb carries there beside its own mass per length",
        "weigh it, with its fastening and tags; what only one run carries is its payload",
        interval="[0, inf)",
    )
    name: str = "mass"


class Load(NamedTuple):
    """How a limb is mounted and what it carries, as a command or a command line says it.

    Attributes:
        payload: [kg] carried beside the limb's own masses.
        payload_at: [m] where, along the limb from its clamp; 0: the tip.
        mounting: a name or degrees of tilt, see the module; empty: as the limb is mounted already.
    """

    payload: float = 0.0
    payload_at: float = 0.0
    mounting: str = ""


def mounting_of(gravity: Sequence[float]) -> str:
    """Return the name of a mounting by its gravity (3,) [m/s²]; its degrees, or gravity itself."""
    x, y, z = (float(value) for value in gravity)
    for name, named in MOUNTINGS.items():
        if math.dist((x, y, z), named) < _SAME_GRAVITY:
            return name
    if abs(x) < _SAME_GRAVITY and abs(z) < _SAME_GRAVITY and abs(y) <= GRAVITY:
        return f"{math.degrees(math.asin(-y / GRAVITY)):.4g}°"
    return f"gravity ({x:.3g}, {y:.3g}, {z:.3g}) m/s²"


def gravity_of(mounting: str) -> tuple[float, float, float]:
    """Return gravity in `limb_base` [m/s²] of a mounting, see the module.

    Raises:
        LimbError: neither a name in `MOUNTINGS` nor degrees of −180 to 180.
    """
    text = str(mounting).strip()
    if text in MOUNTINGS:
        return MOUNTINGS[text]
    try:
        degrees = float(text)
    except ValueError:
        degrees = math.nan
    if not -MOST_TILT <= degrees <= MOST_TILT:
        raise LimbError(
            f"mounting '{mounting}' is unknown: choose {', '.join(MOUNTINGS)}, or degrees of "
            f"{-MOST_TILT:g} to {MOST_TILT:g} by which the plane of motion is tilted about the "
            "straight limb"
        )
    pull = GRAVITY * math.sin(math.radians(degrees))
    # 180 degrees are level, whatever the sine of a rounded π is.
    return (0.0, -pull if abs(pull) > _ROUNDING else 0.0, 0.0)
