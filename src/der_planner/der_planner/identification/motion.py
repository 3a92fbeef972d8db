"""Stiffness from measured motion, where friction is known, without a simulation.

Pressures and bend angles of slow motion tell ratios alone. What tells stiffness is the inertia of a
known mass. A swing shows it badly: friction stops it, at another place than a model's friction
would. While a segment bends on in one way, friction is known, and its bend obeys

    u = (EI / G L) (θ − θ̄) + Σ_j F_j z_j + I / G + …

with I the moment that the acceleration of everything beyond asks for, in the mean over its length,
by measured angles and known masses. Friction is a sum of elements that
turn round over different angles (z, Dahl), the first one at once. It is linear in all that is
unknown, also in unequal chambers, stiffening, coupling and damping. Both sides are smoothed alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter1d

from der_planner.arrays import Array
from der_planner.identification.log import Prepared
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD
from der_planner.model.material import dahl

SMOOTHED = 1.5
"""Standard deviation of the smoothing [rows]."""
BENDS_ON = np.deg2rad(6.0)
"""Rate of a bend from which on it counts [rad/s]: slower, a part of the segment may stick."""
AWAY = 3
"""Rows between those that count and those where the bend is slower, or turns round."""
TURNS = (0.05, 0.2)
"""Bends over which elements of friction turn round, beside one that does so at once [rad]."""
PIECES = 12
"""Pieces of a segment. Inertia bends it most where it begins."""
SHAPES = 3
"""Times that the limb's shape is found, the first one even."""
PASSES = 2
"""Times that the shape is found for the stiffness, and the stiffness for the shape."""
OUTLYING = 2.0
"""Errors beyond this multiple of the usual one count less than their square."""
LEAST_ROWS = 100
"""Rows of a segment from which on they tell anything."""
METHOD_ERROR = 0.05
"""Error of the logarithm of the stiffness by shape, smoothing and partly sticking segments."""
LARGEST_CHANGE = 1.0
"""Largest change of the logarithm of the stiffness."""


def stiffness_in_motion(limb: Limb, log: Prepared, *, even: bool = False) -> tuple[Array, Array]:
    """Return by how much stiffness differs from what was known, and how sure that is.

    Args:
        limb: with its masses and fitted lengths, without weight in its plane.
        log: prepared.
        even: the stiffness of arcs, which are bent evenly by inertia, too.

    Returns:
        (M,) logarithms of stiffness over that of ``limb``, and their standard deviations; infinite
        for a segment that hardly moves.
    """
    angles, pressure = _smooth(log.bend), _smooth(log.pressure)
    rates = np.gradient(angles, CONTROL_PERIOD, axis=0)
    known = np.array([segment.bending_stiffness for segment in limb.segments])
    change, deviation = np.zeros(len(known)), np.full(len(known), np.inf)
    for _ in range(PASSES):
        inertia = _inertia(limb, angles, np.inf * known if even else known * np.exp(change))
        for i, segment in enumerate(limb.segments):
            rows = _rows(rates[:, i], log.usable)
            if rows.sum() < LEAST_ROWS:
                continue
            bend, own, exact = angles[:, i], pressure[:, i], np.ascontiguousarray(log.bend[:, i])
            friction = [np.sign(rates[:, i]), *(_smooth(dahl(exact, turn)) for turn in TURNS)]
            bent = [bend, np.ones_like(bend), bend**3, bend * np.abs(own), np.abs(own)]
            beside = [pressure[:, j] for j in (i - 1, i + 1) if 0 <= j < len(known)]
            columns = np.column_stack([inertia[:, i], *bent, *friction, *beside, rates])
            (inert, elastic), error = _ratios(columns[rows], own[rows])
            if min(elastic, inert) > 0.0:
                told = np.log(segment.length * elastic / inert / segment.bending_stiffness)
                change[i] = np.clip(told, -LARGEST_CHANGE, LARGEST_CHANGE)
                deviation[i] = np.hypot(error / inert, METHOD_ERROR)
    return change, deviation


def _smooth(table: Array) -> Array:
    smooth: Array = gaussian_filter1d(table, SMOOTHED, axis=0)
    return smooth


def _rows(rate: Array, usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the rows (K,) in which a segment bends on, for some time before and after."""
    ways = [binary_erosion(usable & (way * rate > BENDS_ON), iterations=AWAY) for way in (1, -1)]
    return np.asarray(ways[0] | ways[1])


def _ratios(columns: Array, values: Array) -> tuple[Array, float]:
    """Return the first two of the factors that make columns (R, P) values (R,).

    The standard deviation is that of the first one, which is the less certain by far.
    """
    scale = np.abs(columns).max(axis=0) + 1e-30
    table, weight = columns / scale, np.ones(len(values))
    for _ in range(10):
        weighted = weight[:, None] * table
        factors = np.linalg.lstsq(weighted, weight * values, rcond=None)[0]
        left = values - table @ factors
        usual = 1.48 * np.median(np.abs(left)) + 1e-30
        weight = 1.0 / np.sqrt(1.0 + (left / (OUTLYING * usual)) ** 2)
    # Smoothing makes what is left of so many rows alike.
    alike = 2.0 * np.sqrt(np.pi) * SMOOTHED
    covariance = np.linalg.pinv(weighted.T @ weighted) * alike * np.mean((weight * left) ** 2)
    return (factors / scale)[:2], float(np.sqrt(covariance[0, 0]) / scale[0])


def _inertia(limb: Limb, angles: Array, stiffness: Array) -> Array:
    """Return the moments (K, M) that inertia asks for, each the mean over a segment [N·m].

    Args:
        limb: of M segments.
        angles: (K, M) smoothed bend angles [rad].
        stiffness: (M,) by which inertia bends a segment unevenly [N·m²].
    """
    lengths, density, owner = [limb.base_length], [0.0], [-1]
    for i, segment in enumerate(limb.segments):
        lengths += [limb.connector_length if i else 0.0, *[segment.length / PIECES] * PIECES]
        density += [segment.mass_per_length * segment.swing_inertia] * (PIECES + 1)
        owner += [-1, *[i] * PIECES]
    length, masses, of = np.array(lengths), np.array(lengths) * density, np.array(owner)
    for item in limb.masses:
        at = int(np.searchsorted(np.cumsum(length), item.arc_length))
        masses[min(at, len(of) - 1)] += item.mass
    even = np.where(of < 0, 0.0, angles[:, of] / PIECES)
    turned, means = even, np.zeros_like(angles)
    for _ in range(SHAPES):
        steps = length * np.exp(1j * (np.cumsum(turned, axis=1) - 0.5 * turned))
        places = np.cumsum(steps, axis=1) - 0.5 * steps
        forces = np.zeros_like(places)
        forces[1:-1] = masses * np.diff(places, 2, axis=0) / CONTROL_PERIOD**2
        beyond, turning = (_beyond(part) for part in (forces, np.conj(places) * forces))
        moments = (turning - np.conj(places) * beyond).imag
        for i in range(limb.segment_count):
            means[:, i] = moments[:, of == i].mean(axis=1)
        uneven = np.where(of < 0, 0.0, moments - means[:, of]) * length / stiffness[of]
        turned = even - uneven
    return means


def _beyond(parts: Array) -> Array:
    """Return the sums (K, N) of each part and those after it."""
    sums: Array = np.cumsum(parts[:, ::-1], axis=1)[:, ::-1]
    return sums
