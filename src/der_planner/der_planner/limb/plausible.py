"""The one check of magnitudes at every door: numbers that no limb shows have another unit."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.limb.limb import Limb

FEW = 0.02
"""Share of rows up to which impossible numbers are outliers, and not another unit."""
TOO_SMALL = 0.05
"""Share of what is expected below which pressures have another unit, or are not there."""
_UNITS = {"pressures": "Pa, or name pressure_unit", "bend angles": "rad, or name angle_unit"}


def impossible(limb: Limb, what: str, values: ArrayLike) -> NDArray[np.bool_]:
    """Return which rows (…, N) are beyond anything that a limb of this length and limit shows.

    Args:
        limb: whose they should be.
        what: they are: "pressures" [Pa], "bend angles" [rad] or "tips" [m].
        values: NaN, which was not measured, is not impossible.
    """
    most = {
        "pressures": 20.0 * limb.pneumatics.pressure_limit,
        "bend angles": 2.0 * math.pi,
        "tips": 1.5 * limb.length,
    }[what]
    return np.asarray(np.any(np.abs(np.asarray(values, dtype=float)) > most, axis=-1))


def outliers(
    limb: Limb, what: str, values: ArrayLike, error: type[ValueError]
) -> NDArray[np.bool_]:
    """Return the few rows (K,) of a log's values (K, N) that are impossible, see `impossible`.

    Raises:
        ValueError: as ``error``: they are not few.
    """
    rows, size = impossible(limb, what, values), np.abs(np.asarray(values, dtype=float))
    if rows.sum() > FEW * np.isfinite(size).any(axis=-1).sum():
        raise error(
            f"the {what} are about {np.nanmedian(size[rows]):.3g}: give them in {_UNITS[what]} in "
            f"columns.yaml; the limb '{limb.name}' is {limb.length:.3g} m long and takes "
            f"±{limb.pneumatics.pressure_limit:.0f} Pa"
        )
    return rows
