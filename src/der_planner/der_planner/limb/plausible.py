"""Numbers that no limb shows, told from its own length and limits: mostly another unit.

Each function returns which rows are possible; NaN, which was not measured, is. `wrong_unit` is what
a door says where they are not.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb.limb import Limb

Mask = NDArray[np.bool_]

MOST_PRESSURE = 20.0
"""Largest |pressure| over the limb's pressure limit."""
MOST_BEND = 2.0 * math.pi
"""Largest |bend angle| of a segment [rad]."""
FARTHEST = 1.5
"""Largest distance of a tip from the clamp over the limb's length."""
FEW = 0.02
"""Share of rows up to which impossible numbers are outliers, and not another unit."""


def possible_pressures(limb: Limb, pressure: ArrayLike) -> Mask:
    """Return which rows (…, M) of differential pressures are possible [Pa]."""
    return _within(pressure, MOST_PRESSURE * limb.pneumatics.pressure_limit)


def possible_bends(bend_angle: ArrayLike) -> Mask:
    """Return which rows (…, M) of bend angles are possible [rad]."""
    return _within(bend_angle, MOST_BEND)


def possible_tips(limb: Limb, tip: ArrayLike) -> Mask:
    """Return which tips (…, 2) the limb can reach, with some room [m]."""
    away = np.linalg.norm(np.asarray(tip, dtype=float), axis=-1)
    return np.asarray(~(away > FARTHEST * limb.length))


def wrong_unit(what: str, values: ArrayLike, unit: str, limb: Limb) -> str:
    """Return the sentence for impossible numbers.

    Args:
        what: they are, in the plural.
        values: all of them; the median of their sizes is named.
        unit: that they should have.
        limb: whose they should be.
    """
    size = np.abs(np.asarray(values, dtype=float))
    return (
        f"the {what} are about {np.nanmedian(size):.3g}: give them in {unit}, of the limb "
        f"'{limb.name}' of {limb.length:.3g} m and ±{limb.pneumatics.pressure_limit:.0f} Pa"
    )


def _within(values: ArrayLike, most: float) -> Mask:
    return np.asarray(~np.any(np.abs(np.asarray(values, dtype=float)) > most, axis=-1))
