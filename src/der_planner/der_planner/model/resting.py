"""The bend of one segment at rest under changing pressures, with friction and creep; compiled.

With φ = θ − θ_rest, gain g [rad/Pa], friction f [Pa] and creep c [Pa/rad] in pressures,

    φ + k φ³ = g (driven − f z − c q) / stiffer

holds at each instant, z and q following the bend by the laws of `der_planner.model.material`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


class RestingLaw(NamedTuple):
    """The numbers of one segment."""

    gain: float  # g [rad/Pa]
    cubic: float  # k [1/rad²]
    rest: float  # θ_rest [rad]
    friction: float  # f [Pa]
    turn: float  # bend over which friction turns round [rad]
    creep: float  # c [Pa/rad]
    relaxation: float  # of the creep [s]


@njit(cache=True)
def rest_along(time: Array, driven: Array, stiffer: Array, law: RestingLaw, begin: Array) -> Array:
    """Return the bend angle (K,) [rad], solved at each instant by Newton's method.

    Args:
        time: (K,) [s].
        driven: (K,) right side without friction and creep [Pa].
        stiffer: (K,) growth of the stiffness.
        law: of the segment.
        begin: θ [rad], z and q [rad] at ``time[0]``; NaN: at rest under ``driven[0]``, z = q = 0.

    Friction makes the residual rise with θ, and bending away from the last angle stiffens the
    segment: there is one root, on the side to which the residual points at the last angle.
    """
    bend = np.empty(time.shape[0])
    angle, z, q = begin[0], begin[1], begin[2]
    if np.isnan(angle):
        linear = law.gain * driven[0] / stiffer[0]
        angle, z, q = law.rest + linear, 0.0, 0.0
        for _ in range(20):
            bent = angle - law.rest
            angle -= (bent + law.cubic * bent**3 - linear) / (1.0 + 3.0 * law.cubic * bent**2)
    bend[0] = angle
    for k in range(1, time.shape[0]):
        rate = (time[k] - time[k - 1]) / law.relaxation
        keep = np.exp(-rate)
        share = (1.0 - keep) / rate
        last = angle
        scale = law.gain / stiffer[k]
        bent = last - law.rest
        error = bent + law.cubic * bent**3
        error -= scale * (driven[k] - law.friction * z - law.creep * q * keep)
        sign = -1.0 if error > 0.0 else 1.0
        for _ in range(30):
            change = angle - last
            fade = np.exp(-abs(change) / law.turn)
            moved = sign + (z - sign) * fade
            load = law.friction * moved + law.creep * (q * keep + change * share)
            bent = angle - law.rest
            error = bent + law.cubic * bent**3 - scale * (driven[k] - load)
            slope = 1.0 + 3.0 * law.cubic * bent**2
            slope += scale * (law.friction * (1.0 - z * sign) * fade / law.turn + law.creep * share)
            step = error / slope
            angle -= step
            if (angle - last) * sign < 0.0:
                angle = last
            if abs(step) < 1e-12:
                break
        change = angle - last
        z = sign + (z - sign) * np.exp(-abs(change) / law.turn)
        q = q * keep + change * share
        bend[k] = angle
    return bend


class StepSlopes(NamedTuple):
    """Derivatives of each step (K,), by the last θ, z, q and by this instant's drive.

    The first entries are those of the start: at rest under ``driven[0]``, or given and fixed.
    """

    angle_by_angle: Array
    angle_by_friction: Array  # [rad]
    angle_by_creep: Array
    angle_by_driven: Array  # [rad/Pa]
    angle_by_stiffer: Array  # [rad]
    friction_kept: Array
    friction_by_change: Array  # [1/rad]
    creep_kept: Array
    creep_by_change: Array


@njit(cache=True)
def rest_slopes(
    time: Array, stiffer: Array, bend: Array, law: RestingLaw, begin: Array
) -> StepSlopes:
    """Return the derivatives of each step along bend angles (K,) found by `rest_along`.

    By the implicit function theorem on the step's residual
    φ + k φ³ − g (driven − f z' − c q') / stiffer = 0 with z' = s + (z − s) exp(−|Δθ| / turn), s the
    sign of Δθ, and q' = keep q + share Δθ.
    """
    count = time.shape[0]
    angle, friction, creep = np.zeros(count), np.zeros(count), np.zeros(count)
    by_driven, by_stiffer = np.zeros(count), np.zeros(count)
    z_kept, z_change = np.zeros(count), np.zeros(count)
    q_kept, q_change = np.zeros(count), np.zeros(count)
    known = not np.isnan(begin[0])
    z = begin[1] if known else 0.0
    for k in range(count):
        bent = bend[k] - law.rest
        stiffness = 1.0 + 3.0 * law.cubic * bent**2
        scale = law.gain / stiffer[k]
        if k > 0:
            rate = (time[k] - time[k - 1]) / law.relaxation
            change = bend[k] - bend[k - 1]
            sign = 1.0 if change >= 0.0 else -1.0
            z_kept[k] = np.exp(-abs(change) / law.turn)
            z_change[k] = (1.0 - z * sign) * z_kept[k] / law.turn
            q_kept[k] = np.exp(-rate)
            q_change[k] = (1.0 - q_kept[k]) / rate
            z = sign + (z - sign) * z_kept[k]
        rub = scale * (law.friction * z_change[k] + law.creep * q_change[k])
        total = stiffness + rub
        if k == 0 and known:
            continue
        angle[k] = rub / total
        friction[k] = -scale * law.friction * z_kept[k] / total
        creep[k] = -scale * law.creep * q_kept[k] / total
        by_driven[k] = scale / total
        by_stiffer[k] = -(bent + law.cubic * bent**3) / stiffer[k] / total
    return StepSlopes(
        angle, friction, creep, by_driven, by_stiffer, z_kept, z_change, q_kept, q_change
    )


@dataclass(frozen=True)
class RestingSlopes:
    """First-order change of what friction and creep take, by the drive of the same segment."""

    law: RestingLaw
    steps: StepSlopes

    def tangent(self, driven: Array, stiffer: Array) -> Array:
        """Return the change (K,) of f z + c q [Pa] by changes (K,) of the drive."""
        result: Array = _tangent(self.law, self.steps, driven.copy(), stiffer.copy())
        return result

    def adjoint(self, weight: Array) -> tuple[Array, Array]:
        """Return the gradient of Σ weight (f z + c q) by ``driven`` and by ``stiffer``, (K,)."""
        gradients: tuple[Array, Array] = _adjoint(self.law, self.steps, weight.copy())
        return gradients


@njit(cache=True)
def _tangent(law: RestingLaw, steps: StepSlopes, driven: Array, stiffer: Array) -> Array:
    result = np.empty(driven.shape[0])
    angle, z, q = 0.0, 0.0, 0.0
    for k in range(driven.shape[0]):
        before = angle
        angle = (
            steps.angle_by_angle[k] * angle
            + steps.angle_by_friction[k] * z
            + steps.angle_by_creep[k] * q
            + steps.angle_by_driven[k] * driven[k]
            + steps.angle_by_stiffer[k] * stiffer[k]
        )
        z = steps.friction_kept[k] * z + steps.friction_by_change[k] * (angle - before)
        q = steps.creep_kept[k] * q + steps.creep_by_change[k] * (angle - before)
        result[k] = law.friction * z + law.creep * q
    return result


@njit(cache=True)
def _adjoint(law: RestingLaw, steps: StepSlopes, weight: Array) -> tuple[Array, Array]:
    count = weight.shape[0]
    driven, stiffer = np.empty(count), np.empty(count)
    angle, z, q = 0.0, 0.0, 0.0  # gradients by the state after step k
    for k in range(count - 1, -1, -1):
        z += weight[k] * law.friction
        q += weight[k] * law.creep
        moved = z * steps.friction_by_change[k] + q * steps.creep_by_change[k]
        total = angle + moved
        driven[k] = total * steps.angle_by_driven[k]
        stiffer[k] = total * steps.angle_by_stiffer[k]
        angle = total * steps.angle_by_angle[k] - moved
        z = z * steps.friction_kept[k] + total * steps.angle_by_friction[k]
        q = q * steps.creep_kept[k] + total * steps.angle_by_creep[k]
    return driven, stiffer
