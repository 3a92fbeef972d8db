"""The bend of a limb at rest under changing pressures and its weight, with friction and creep.

With φ = θ − θ_rest of each segment, gain g [rad/Pa], friction f [Pa] and creep c [Pa/rad] in
pressures,

    φ + k φ³ = g (driven − f z − c q) / stiffer + W(θ)

holds at each instant, z and q following the bend by the laws of `der_planner.model.material`. W is
the torque of gravity on the segment's bend over the segment's stiffness, for evenly bent segments:
the only term that couples them. Friction and creep hardly care that a loaded limb does not bend
quite evenly, and no other use is made of this bend.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit

from der_planner.arrays import Array
from der_planner.limb import Limb

_PIECES = 4
"""Straight pieces of a segment that carry its weight."""
_ROUNDS = 200
"""Sweeps over the segments at the most; without weight one is enough."""
_CLOSE = 1e-7
"""Change of a bend angle in a sweep with which its balance is found [rad]."""
_LARGEST_STEP = 0.3
"""Of a bend angle in one iteration [rad]."""
_LARGEST_BEND = 6.0
"""Of a segment [rad]."""


class RestingLaw(NamedTuple):
    """The numbers of M segments."""

    gain: Array  # (M,) g [rad/Pa]
    cubic: Array  # (M,) k [1/rad²]
    rest: Array  # (M,) θ_rest [rad]
    friction: Array  # (M,) f [Pa]
    turn: Array  # (M,) bend over which friction turns round [rad]
    creep: Array  # (M,) c [Pa/rad]
    relaxation: Array  # (M,) of the creep [s]
    stiffness: Array  # (M,) EI / L [N·m/rad]
    weight: Weight


class Weight(NamedTuple):
    """Gravity on straight pieces, E in a chain of evenly bent segments.

    A piece with heading ψ_e = Σ_j turning_ej θ_j has the torque lever_e · (e(ψ_e) × gravity).
    """

    lever: Array  # (E,) first moment of the piece, and its length times the mass beyond [kg·m]
    turning: Array  # (E, M) share of each bend angle in the heading
    gravity: Array  # (2,) [m/s²]


def weight_of(limb: Limb) -> Weight:
    """Return the weight in the plane of segments, connectors and carried masses.

    A limb that no gravity pulls in its plane has no pieces.
    """
    gravity = np.array(limb.gravity[:2], dtype=float)
    count = limb.segment_count
    if not gravity.any():
        return Weight(np.zeros(0), np.zeros((0, count)), gravity)
    pieces: list[tuple[float, float, Array]] = []  # length, mass and turning of each
    for index, segment in enumerate(limb.segments):
        before = (np.arange(count) < index).astype(float)
        if index and limb.connector_length:
            density = limb.segments[index - 1].mass_per_length + segment.mass_per_length
            pieces.append((limb.connector_length, 0.5 * density * limb.connector_length, before))
        for place in (np.arange(_PIECES) + 0.5) / _PIECES:
            part = segment.length / _PIECES
            share = np.where(np.arange(count) == index, place, before)
            pieces.append((part, segment.mass_per_length * part, share))
    length, mass, turning = map(np.array, zip(*pieces, strict=True))
    ends = limb.base_length + np.cumsum(length)
    first = 0.5 * mass * length
    for item in limb.masses:
        if item.arc_length <= limb.base_length:
            continue
        piece = min(int(np.searchsorted(ends, item.arc_length)), len(ends) - 1)
        mass[piece] += item.mass
        first[piece] += item.mass * (item.arc_length - ends[piece] + length[piece])
    beyond = np.append(np.cumsum(mass[::-1])[::-1][1:], 0.0)
    return Weight(first + length * beyond, turning, gravity)


@njit(cache=True)
def weigh(angle: Array, law: RestingLaw, torque: Array, slope: Array) -> None:
    """Write W (M,) [rad] at bend angles (M,) and its slope ∂W/∂θ (M, M)."""
    weight = law.weight
    torque[:] = 0.0
    slope[:] = 0.0
    count = angle.shape[0]
    for e in range(weight.lever.shape[0]):
        heading = 0.0
        for i in range(count):
            heading += weight.turning[e, i] * angle[i]
        x, y = np.cos(heading), np.sin(heading)
        turns = weight.lever[e] * (x * weight.gravity[1] - y * weight.gravity[0])
        falls = -weight.lever[e] * (x * weight.gravity[0] + y * weight.gravity[1])
        for i in range(count):
            torque[i] += weight.turning[e, i] * turns
            for j in range(count):
                share = weight.turning[e, i] * weight.turning[e, j]
                slope[i, j] += share * falls
    for i in range(count):
        torque[i] /= law.stiffness[i]
        slope[i] /= law.stiffness[i]


@njit(cache=True)
def rest_along(time: Array, driven: Array, stiffer: Array, law: RestingLaw) -> Array:
    """Return the bend angles (K, M) [rad], solved at each instant by Newton's method.

    The limb has rested under ``driven[0]``, with z = q = 0.

    Args:
        time: (K,) [s].
        driven: (K, M) pressures without friction and creep [Pa].
        stiffer: (K, M) growth of the stiffness.
        law: of the segments.
    """
    instants, count = driven.shape
    bend = np.empty((instants, count))
    angle = law.rest.copy()
    z, q, keep, share = np.zeros((4, count))
    balance(angle, law, Instant(driven[0], stiffer[0], law.rest, z, q, keep, share))
    bend[0] = angle
    for k in range(1, instants):
        for i in range(count):
            rate = (time[k] - time[k - 1]) / law.relaxation[i]
            keep[i] = np.exp(-rate)
            share[i] = (1.0 - keep[i]) / rate
        last = bend[k - 1]
        if k > 1:  # most often it goes on as before, and the search is short
            angle += last - bend[k - 2]
        balance(angle, law, Instant(driven[k], stiffer[k], last, z, q, keep, share))
        for i in range(count):
            change = angle[i] - last[i]
            sign = 1.0 if change >= 0.0 else -1.0
            z[i] = sign + (z[i] - sign) * np.exp(-abs(change) / law.turn[i])
            q[i] = q[i] * keep[i] + change * share[i]
        bend[k] = angle
    return bend


class Instant(NamedTuple):
    """What the balance of one instant knows, (M,) each."""

    driven: Array  # pressures without friction and creep [Pa]
    stiffer: Array  # growth of the stiffness
    last: Array  # θ of the instant before [rad]
    friction: Array  # z of the instant before
    creep: Array  # q of the instant before [rad]
    keep: Array  # share of q that is left
    share: Array  # of a change of θ that q takes; zero: an instant without memory


@njit(cache=True)
def balance(angle: Array, law: RestingLaw, instant: Instant) -> None:
    """Move the angles (M,) to where the moments of one instant balance.

    One segment after the other, with W to first order about the angles of the sweep before; the
    balance of all is convex below the load that buckles the limb, so that this converges.
    """
    count = angle.shape[0]
    torque, slope = np.empty(count), np.empty((count, count))
    heavy = law.weight.lever.shape[0] > 0
    for _ in range(_ROUNDS):
        weigh(angle, law, torque, slope)
        moved, before = 0.0, angle.copy()
        for i in range(count):
            pulled = torque[i]
            for j in range(count):
                if j != i:
                    pulled += slope[i, j] * (angle[j] - before[j])
            found = balanced_bend(i, before[i], law, instant, pulled, slope[i, i])
            step = found - before[i]
            if heavy:
                step = min(max(step, -_LARGEST_STEP), _LARGEST_STEP)
            angle[i] = before[i] + step
            moved = max(moved, abs(step))
        if not heavy or moved < _CLOSE:
            return


@njit(cache=True)
def balanced_bend(
    i: int, now: float, law: RestingLaw, instant: Instant, pulled: float, pulled_slope: float
) -> float:
    """Return θ of segment i, where W = pulled + pulled_slope · (θ − now).

    Friction makes the residual rise with θ, and bending away from the last angle stiffens the
    segment: there is one root, on the side to which the residual points at the last angle.
    """
    driven, last = instant.driven[i], instant.last[i]
    z, kept, share = instant.friction[i], instant.creep[i] * instant.keep[i], instant.share[i]
    scale = law.gain[i] / instant.stiffer[i]
    memory = share > 0.0
    friction = law.friction[i] if memory else 0.0
    bent = last - law.rest[i]
    error = bent + law.cubic[i] * bent**3 - pulled - pulled_slope * (last - now)
    error -= scale * (driven - friction * z - law.creep[i] * kept)
    sign = -1.0 if error > 0.0 else 1.0
    angle = now if memory and (now - last) * sign > 0.0 else last
    for _ in range(30):
        change = angle - last
        fade = np.exp(-abs(change) / law.turn[i]) if memory else 1.0
        moved = sign + (z - sign) * fade
        load = friction * moved + law.creep[i] * (kept + change * share)
        bent = angle - law.rest[i]
        error = bent + law.cubic[i] * bent**3 - scale * (driven - load)
        error -= pulled + pulled_slope * (angle - now)
        slope = 1.0 + 3.0 * law.cubic[i] * bent**2 - pulled_slope
        slope += scale * (friction * (1.0 - z * sign) * fade / law.turn[i] + law.creep[i] * share)
        # A spring that softens with bend has no balance beyond some load: the bend ends there.
        step = min(max(error / max(slope, 0.05), -_LARGEST_STEP), _LARGEST_STEP)
        angle = min(max(angle - step, law.rest[i] - _LARGEST_BEND), law.rest[i] + _LARGEST_BEND)
        if (angle - last) * sign < 0.0:
            angle = last
        if abs(step) < 1e-9:
            break
    return angle


@njit(cache=True)
def change_along(
    time: Array, stiffer: Array, bend: Array, law: RestingLaw, driven: Array
) -> tuple[Array, Array]:
    """Return what P small changes make of a bend at rest, to first order.

    Along bend angles (K, M) found by `rest_along`, by the implicit function theorem on the residual
    of each instant, φ + k φ³ − W(θ) − g (driven − f z' − c q') / stiffer with z' = s + (z − s)
    exp(−|Δθ| / turn), s the sign of Δθ, and q' = keep q + share Δθ. The limb starts at rest.

    Args:
        time: (K,) [s].
        stiffer: (K, M) growth of the stiffness.
        bend: (K, M) [rad].
        law: of the segments.
        driven: (K, M, P) change of g (driven − f z − c q) / stiffer − φ − k φ³ + W at a given bend
            [rad].

    Returns:
        (K, M, P) changes of the bend [rad], and of f z + c q by that of the bend [Pa].
    """
    instants, count, changes = driven.shape
    bend_by, taken_by = np.empty(driven.shape), np.empty(driven.shape)
    z = np.zeros(count)
    torque, slope = np.zeros(count), np.zeros((count, count))
    angle_moved, z_moved, q_moved = np.zeros((3, count, changes))
    for k in range(instants):
        weigh(bend[k], law, torque, slope)
        matrix, right = -slope, driven[k].copy()
        z_kept, z_by_change = np.zeros((count, 1)), np.zeros((count, 1))
        q_kept, q_by_change = np.zeros((count, 1)), np.zeros((count, 1))
        for i in range(count):
            bent = bend[k, i] - law.rest[i]
            scale = law.gain[i] / stiffer[k, i]
            if k > 0:
                rate = (time[k] - time[k - 1]) / law.relaxation[i]
                turned = bend[k, i] - bend[k - 1, i]
                sign = 1.0 if turned >= 0.0 else -1.0
                z_kept[i, 0] = np.exp(-abs(turned) / law.turn[i])
                z_by_change[i, 0] = (1.0 - z[i] * sign) * z_kept[i, 0] / law.turn[i]
                q_kept[i, 0] = np.exp(-rate)
                q_by_change[i, 0] = (1.0 - q_kept[i, 0]) / rate
                z[i] = sign + (z[i] - sign) * z_kept[i, 0]
            rub = scale * (law.friction[i] * z_by_change[i, 0] + law.creep[i] * q_by_change[i, 0])
            matrix[i, i] += 1.0 + 3.0 * law.cubic[i] * bent**2 + rub
            right[i] += rub * angle_moved[i]
            right[i] -= scale * law.friction[i] * z_kept[i, 0] * z_moved[i]
            right[i] -= scale * law.creep[i] * q_kept[i, 0] * q_moved[i]
        after = np.linalg.solve(matrix, right)
        z_moved = z_kept * z_moved + z_by_change * (after - angle_moved)
        q_moved = q_kept * q_moved + q_by_change * (after - angle_moved)
        angle_moved = after
        bend_by[k] = after
        for i in range(count):
            taken_by[k, i] = law.friction[i] * z_moved[i] + law.creep[i] * q_moved[i]
    return bend_by, taken_by
