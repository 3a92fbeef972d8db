"""Open-loop prediction of a log from its measured pressures alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.actuation import slow_effective_pressure
from der_planner.identification.prediction import bend_of
from der_planner.limb import Limb
from der_planner.pcc import Pcc
from der_planner.rod import Rod

Array = NDArray[np.float64]

NODES = 21


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
    """
    seen = limb.for_model(model)
    period = float(time[1] - time[0])
    effective = slow_effective_pressure(seen, time, differential_pressure)
    return Prediction(*_simulate(seen, effective, period, model))


def _simulate(limb: Limb, effective: Array, period: float, model: str) -> tuple[Array, Array]:
    middle = 0.5 * (effective[1:] + effective[:-1])
    if model == "pcc":
        pcc = Pcc(limb)
        stiffness = np.array([s.bending_stiffness / s.length for s in limb.segments])
        start = pcc.rest + pcc.gain * effective[0] / stiffness
        steps = max(1, round(period / 0.01))
        held = np.repeat(middle[:, None, :], steps, axis=1)
        angles, _ = pcc.simulate(held, period / steps, angles=start)
        return angles, pcc.tip(angles)
    rod = Rod.from_limb(limb, NODES)
    run = rod.simulate(rod.equilibrium(effective[0]), middle, period)
    tip: Array = run.tip[:, :2]
    return bend_of(rod, run.q), tip
