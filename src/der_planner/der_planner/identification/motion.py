"""Stiffness from measured motion in which friction is known, without a simulation.

Pressures and bend angles of slow motion tell ratios alone. What tells stiffness is the inertia of a
known mass. A swing shows it badly: friction stops it, at another place than a model's friction
would. While a segment bends on in one way, friction is known, and its bend θ obeys

    u = (EI / G L) (θ − θ̄) + Σ_j F_j z_j + I / G + …

with I the moment that the acceleration of everything beyond asks for, in the mean over its length,
by measured angles and known masses. Friction is a sum of elements that turn round over different
angles (z, Dahl), the first one at once. All that is unknown enters in proportion, also unequal
chambers, stiffening, coupling and damping. Both sides are smoothed alike.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter1d

from der_planner.arrays import Array
from der_planner.identification.log import Prepared
from der_planner.limb import Limb
from der_planner.model import CONTROL_PERIOD, ArcModel
from der_planner.model.material import dahl

SMOOTHED = 1.5
"""Standard deviation of the smoothing [rows]."""
BENDS_ON = np.deg2rad(6.0)
"""Rate of a bend from which on it counts [rad/s]: slower, a part of the segment may stick."""
AWAY = 3
"""Rows between those that count and those where the bend is slower, or turns round."""
TURNS = (0.05, 0.2)
"""Bends over which elements of friction turn round, beside one that does so at once [rad]."""
PIECES = 3
"""Arcs that stand for a segment: inertia bends it most where it begins."""
SHAPES = 3
"""Times that the limb's shape is found, the first one even."""
PASSES = 2
"""Times that the shape is found for the stiffness, and the stiffness for the shape."""
LEAST_ROWS = 100
"""Rows of a segment from which on they tell anything."""
OUTLYING = 3.0
"""Errors beyond this multiple of the median one count less than their square."""
ROUNDS = 8
"""Times that they are weighed."""
SURE = 0.14
"""Deviation of its logarithm up to which motion tells the stiffness."""
_smooth = partial(gaussian_filter1d, sigma=SMOOTHED, axis=0)


def stiffness_in_motion(limb: Limb, log: Prepared) -> tuple[Array, Array]:
    """Return by how much stiffness differs from what was known, and how sure that is.

    Args:
        limb: with its masses and fitted lengths, without weight in its plane.
        log: prepared.

    Returns:
        (M,) logarithms of stiffness over that of ``limb``, and their standard deviations; infinite
        where motion does not tell it.
    """
    bend, pressure = _smooth(log.bend), _smooth(log.pressure)
    rate = np.gradient(bend, CONTROL_PERIOD, axis=0)
    apart = np.ones((2 * AWAY + 1, 1), dtype=bool)
    ways = [binary_erosion(way * rate > BENDS_ON, apart) for way in (1, -1)]
    counts = (ways[0] | ways[1]) & binary_erosion(log.usable, apart[:, 0])[:, None]
    change, deviation = np.zeros(limb.segment_count), np.full(limb.segment_count, np.inf)
    for _ in range(PASSES):
        inertia = _inertia(limb, bend, change)
        for i, segment in enumerate(limb.segments):
            rows = counts[:, i]
            if rows.sum() < LEAST_ROWS:
                continue
            angle, own, exact = bend[:, i], pressure[:, i], np.ascontiguousarray(log.bend[:, i])
            friction = [np.sign(rate[:, i]), *(_smooth(dahl(exact, turn)) for turn in TURNS)]
            bent = [angle, np.ones_like(angle), angle**3, angle * np.abs(own), np.abs(own)]
            beside = [pressure[:, j] for j in (i - 1, i + 1) if 0 <= j < limb.segment_count]
            columns = np.column_stack([inertia[:, i], *bent, *friction, *beside, rate])
            (inert, elastic), error = _factors(columns[rows], own[rows])
            if min(inert, elastic) > 0.0:
                change[i] = np.log(segment.length * elastic / inert / segment.bending_stiffness)
                deviation[i] = error / inert if error < SURE * inert else np.inf
    return change, deviation


def _factors(columns: Array, values: Array) -> tuple[Array, float]:
    """Return the first two of the factors that make columns (R, P) values (R,).

    The standard deviation is that of the first one, which is the less certain by far.
    """
    scale, weight = np.abs(columns).max(axis=0, initial=1e-30), np.ones(len(values))
    for _ in range(ROUNDS):
        weighed = weight[:, None] * columns / scale
        inverse = np.linalg.pinv(weighed.T @ weighed, hermitian=True)
        factors = inverse @ (weighed.T @ (weight * values)) / scale
        left = values - columns @ factors
        weight = 1.0 / np.hypot(1.0, left / (OUTLYING * np.median(np.abs(left)) + 1e-30))
    # Smoothing makes what is left of so many rows alike.
    variance = 2.0 * np.sqrt(np.pi) * SMOOTHED * np.mean((weight * left) ** 2)
    return factors[:2], float(np.sqrt(variance * inverse[0, 0]) / scale[0])


def _inertia(limb: Limb, bend: Array, change: Array) -> Array:
    """Return the moments (K, M) that inertia asks for, each the mean over a segment [N·m].

    Args:
        limb: of M segments; what connects them bends with them.
        bend: (K, M) smoothed bend angles [rad].
        change: (M,) of the logarithm of the stiffness, by which inertia bends a segment unevenly.
    """
    longer = limb.connector_length * (1.0 - 1.0 / limb.segment_count)
    undamped = [replace(item, damping=0.0, material_damping=0.0) for item in limb.segments]
    pieces = [
        replace(s, length=(s.length + longer) / PIECES) for s in undamped for _ in range(PIECES)
    ]
    arcs = ArcModel(replace(limb, segments=tuple(pieces), pcc_segments=(), connector_length=0.0))
    flexible = np.repeat(np.exp(-change), PIECES) / arcs.stiffness
    even = np.repeat(bend / PIECES, PIECES, axis=1)
    bent = even
    for _ in range(SHAPES):
        rate, acceleration = np.gradient(bent, CONTROL_PERIOD, axis=0), np.zeros_like(bent)
        acceleration[1:-1] = np.diff(bent, 2, axis=0) / CONTROL_PERIOD**2
        beyond = arcs.inverse_dynamics(bent, rate, acceleration) - arcs.static_pressure(bent)
        moments = arcs.gain * beyond
        means: Array = moments.reshape(len(bend), -1, PIECES).mean(axis=2)
        bent = even - flexible * (moments - np.repeat(means, PIECES, axis=1))
    return means
