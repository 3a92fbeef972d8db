"""Open-loop prediction of a log from its measured pressures alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.identification.logs.log import LogError
from der_planner.limb import Limb
from der_planner.model import Model, simulate

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Prediction:
    """An open-loop prediction.

    Attributes:
        bend_angles: (K, M) [rad].
        tip: (K, 2) [m].
    """

    bend_angles: Array
    tip: Array


def predict(
    limb: Limb,
    time: Array,
    differential_pressure: Array,
    model: str = "der",
) -> Prediction:
    """Predict the bend of a limb from the pressures in its chambers.

    Args:
        limb: calibrated limb.
        time: (K,) regular [s].
        differential_pressure: (K, M) measured [Pa], without gaps.
        model: ``der`` or ``pcc``.

    Returns:
        Bend angles and tips at ``time``, from the equilibrium of the first pressures on. Measured
        angles are not used.

    Raises:
        LogError: the model cannot follow the pressures, or does not come to rest.
    """
    try:
        response = simulate(Model.of(limb, model), time, pressures=differential_pressure)
    except RuntimeError as error:
        raise LogError(
            f"the {model} model of the limb '{limb.name}' cannot follow this log ({error}): check "
            "that the limb file is that of this limb, with its mounting and what it carries"
        ) from error
    return Prediction(response.bend_angles, response.tip)
