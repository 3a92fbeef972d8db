"""The same data for the baseline: stiffness and damping of the constant-curvature model.

Under no gravity both models have the same statics, segment by segment, so gain, rest angle, unequal
chambers, stiffening, friction and creep are shared. Their dynamics differ - an arc is stiffer
than a rod that may bend unevenly - and are fitted to each.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.prepare import Prepared
from der_planner.limb import Limb, Segment
from der_planner.model.inputs import pressures_between
from der_planner.model.material import slow_effective_pressure
from der_planner.model.response import ArcModel

Array = NDArray[np.float64]

SPREAD = np.array([0.3, 0.02, 0.5])
"""Prior standard deviations of ln stiffness, material damping [s] and ln damping."""
ANGLE_ERROR = np.deg2rad(0.3)
CORRELATION = 20.0
STEPS = 2
"""Runge-Kutta steps in a row of the grid."""


def fit_pcc(limb: Limb, prepared: Prepared, offset: Array) -> tuple[tuple[Segment, ...], Array]:
    """Fit the PCC model's dynamics, with the statics of an identified limb.

    Args:
        limb: identified for the rod.
        prepared: the log.
        offset: (M,) of the pressure sensors [Pa].

    Returns:
        The segments for the PCC model, and its root mean square errors (M,) [rad].
    """
    time = prepared.log.time
    pressure = prepared.pressure - offset
    effective = slow_effective_pressure(limb, time, pressure)
    held = pressures_between(effective, STEPS)
    period = float(time[1] - time[0])
    count = limb.segment_count
    rows = prepared.usable

    def angles(x: Array) -> Array:
        arcs = ArcModel(replace(limb, segments=segments_of(limb, x)))
        return arcs.run(arcs.resting(effective[0]), held, period).bend_angles

    def residual(x: Array) -> Array:
        data = (angles(x) - prepared.log.bend_angles)[rows] / (ANGLE_ERROR * np.sqrt(CORRELATION))
        prior = np.concatenate([x[:count] / SPREAD[0], (x[count : 2 * count] - before) / SPREAD[1]])
        return np.concatenate([data.ravel(), prior, x[-1:] / SPREAD[2]])

    before = np.array([segment.material_damping for segment in limb.segments])
    start = np.concatenate([np.zeros(count), before + 1e-4, [0.0]])
    low = np.concatenate([np.full(count, -1.2), np.zeros(count), [-3.0]])
    high = np.concatenate([np.full(count, 1.2), np.full(count, 0.12), [3.0]])
    solution = least_squares(
        residual,
        start,
        bounds=(low, high),
        x_scale=np.concatenate([np.full(count, 0.2), np.full(count, 0.01), [0.5]]),
        loss="soft_l1",
        f_scale=3.0 / np.sqrt(CORRELATION),
        diff_step=np.full(len(start), 1e-3),
        xtol=1e-3,
        ftol=1e-4,
        max_nfev=4,
    )
    error = np.sqrt(np.nanmean((angles(solution.x) - prepared.log.bend_angles) ** 2, axis=0))
    return segments_of(limb, solution.x), np.asarray(error)


def segments_of(limb: Limb, x: Array) -> tuple[Segment, ...]:
    """Return the segments with stiffness × e^x, material damping and damping × e^x put in place.

    Cubic term, gain, friction and creep scale with the stiffness: the statics stay as they are.
    """
    count = limb.segment_count
    result = []
    for index, segment in enumerate(limb.segments):
        factor = float(np.exp(x[index]))
        result.append(
            replace(
                segment,
                bending_stiffness=segment.bending_stiffness * factor,
                cubic_stiffness=segment.cubic_stiffness * factor,
                moment_gain=segment.moment_gain * factor,
                friction_moment=segment.friction_moment * factor,
                creep_stiffness=segment.creep_stiffness * factor,
                material_damping=float(x[count + index]),
                damping=segment.damping * float(np.exp(x[-1])),
            )
        )
    return tuple(result)
