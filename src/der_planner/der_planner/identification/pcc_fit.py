"""The same data for the baseline: the numbers of the constant-curvature model.

Without gravity both models have the same statics, segment by segment, so gain, rest angle, unequal
chambers, stiffening, friction and creep are shared, and only stiffness and damping are fitted to
each: an arc is stiffer than a rod that may bend unevenly. Under gravity their statics differ as
well, and the arcs get gains and rest angles of their own from the same log.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from der_planner.identification.logs.prepare import Prepared
from der_planner.limb import Limb, Segment
from der_planner.model import ArcModel
from der_planner.model.material import Material
from der_planner.model.simulation import means_between

Array = NDArray[np.float64]

SPREAD = np.array([0.3, 0.02, 0.2, 0.2, 0.5])
"""Prior standard deviations of ln stiffness, material damping [s], ln gain, rest angle [rad] and ln
damping, about the rod's."""
SCALE = np.array([0.2, 0.01, 0.1, 0.05, 0.5])
LOW = np.array([-1.2, 0.0, -0.8, -0.8, -3.0])
HIGH = np.array([1.2, 0.12, 0.8, 0.8, 3.0])
NOT_FOLLOWED = np.pi
"""Error of a row in which the arcs have left every bound [rad]."""
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
        The segments for the PCC model, and its root mean square errors (M,) [rad]; NaN if the arcs
        cannot follow the log.
    """
    time = prepared.log.time
    pressure = prepared.pressure - offset
    effective = Material(limb).slow_effective_pressure(time, pressure)
    held = means_between(effective, STEPS)
    period = float(time[1] - time[0])
    count = limb.segment_count
    rows = prepared.usable

    def angles(x: Array) -> Array:
        arcs = ArcModel(replace(limb, segments=segments_of(limb, x)))
        try:
            return arcs.run(arcs.resting(effective[0]), held, period).bend_angles
        except RuntimeError:  # arcs that buckle under their load do not come to rest
            return np.full(prepared.log.bend_angles.shape, np.nan)

    def residual(x: Array) -> Array:
        error = (angles(x) - prepared.log.bend_angles)[rows]
        error = np.where(np.isfinite(error), error, NOT_FOLLOWED)
        data = error / (ANGLE_ERROR * np.sqrt(CORRELATION))
        return np.concatenate([data.ravel(), ((x - centre) / spread)[free]])

    centre, spread, scale, low, high, free = _unknowns(limb)
    start = centre + np.repeat([0.0, 1e-4, 0.0, 0.0, 0.0], [count, count, count, count, 1])

    def put(part: Array) -> Array:
        x: Array = start.copy()
        x[free] = part
        return x

    def of_part(part: Array) -> Array:
        return residual(put(part))

    solution = least_squares(
        of_part,
        start[free],
        bounds=(low[free], high[free]),
        x_scale=scale[free],
        loss="soft_l1",
        f_scale=3.0 / np.sqrt(CORRELATION),
        diff_step=np.full(int(free.sum()), 1e-3),
        xtol=1e-3,
        ftol=1e-4,
        max_nfev=8,
    )
    found = put(solution.x)
    error = (angles(found) - prepared.log.bend_angles)[rows]
    return segments_of(limb, found), np.asarray(np.sqrt(np.mean(error**2, axis=0)))


def _unknowns(limb: Limb) -> tuple[Array, Array, Array, Array, Array, NDArray[np.bool_]]:
    """Return centres, spreads, scales and bounds of the (4M + 1,) unknowns, and which are free."""
    count = limb.segment_count

    def each(values: Array) -> Array:
        return np.append(np.repeat(values[:4], count), values[4])

    centre = np.zeros(4 * count + 1)
    centre[count : 2 * count] = [segment.material_damping for segment in limb.segments]
    free = np.ones(len(centre), dtype=bool)
    free[2 * count : 4 * count] = any(limb.gravity[:2])
    return centre, each(SPREAD), each(SCALE), each(LOW), each(HIGH), free


def segments_of(limb: Limb, x: Array) -> tuple[Segment, ...]:
    """Return the segments with the arcs' numbers put in place.

    ``x`` (4M + 1,) holds for each segment ln stiffness, material damping, ln gain and change of the
    rest angle, then ln damping. Cubic term, gain, friction and creep scale with the stiffness, the
    last two with the gain as well: where it alone is changed, the statics stay as they are.
    """
    count = limb.segment_count
    result = []
    for index, segment in enumerate(limb.segments):
        factor = float(np.exp(x[index]))
        drive = factor * float(np.exp(x[2 * count + index]))
        result.append(
            replace(
                segment,
                bending_stiffness=segment.bending_stiffness * factor,
                cubic_stiffness=segment.cubic_stiffness * factor,
                moment_gain=segment.moment_gain * drive,
                friction_moment=segment.friction_moment * drive,
                creep_stiffness=segment.creep_stiffness * drive,
                material_damping=float(x[count + index]),
                rest_curvature=segment.rest_curvature
                + float(x[3 * count + index]) / segment.length,
                damping=segment.damping * float(np.exp(x[-1])),
            )
        )
    return tuple(result)
