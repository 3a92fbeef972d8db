"""Stiffness beside a fit: from motion in which friction is known, or from a known weight.

Pressures and bend angles of slow motion tell ratios alone: gain over stiffness, friction over gain.

**Motion.** What tells stiffness is the inertia of a known mass. A swing shows it badly: friction
stops it, at another place than a model's friction would. While a segment bends on in one way,
friction is known, and its bend θ obeys

    u = (EI / G L) (θ − θ̄) + Σ_j F_j z_j + I / G + …

with I the moment that the acceleration of everything beyond asks for, in the mean over its length,
by measured angles and known masses. Friction is a sum of elements that turn round over different
angles (z, Dahl), the first one at once. All that is unknown enters in proportion, also unequal
chambers, stiffening, coupling and damping. Both sides are smoothed alike. What noise of the bend
angles adds to the squares of I and θ is taken off: as inertia that no pressure moves, it would make
the limb seem stiff.

**A known weight**, hung on the resting limb for some seconds, needs no motion. A known force bends
the resting limb by

    EI (s(φ₁) − s(φ₀)) / L + f = τ,        s(φ) = φ + k φ³

with φ₀ and φ₁ the bend of a segment beyond that which its pressure gives it, before and under the
weight, τ the torque of the weight, and of the limb's own moved one, on the segment's bend, and f
friction, which has turned against the motion. Friction is known as a bend angle b = f L / EI, so
that EI = τ L / (s(φ₁) − s(φ₀) + b). Before the weight, friction may hold the limb either way: b is
known to b / √3.

A limb that leaves a wall, or hangs at an angle, is pulled along its gravity. One that lies on a
plate is pulled sideways, by a thread that leaves it across the straight limb and runs over a
pulley.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter1d

from der_planner.arrays import Array
from der_planner.identification.log import LogError, Prepared
from der_planner.limb import Limb
from der_planner.limb.loads import GRAVITY
from der_planner.model import CONTROL_PERIOD, ArcModel
from der_planner.model.material import dahl

SMOOTHED = 2.0
"""Standard deviation of the smoothing [rows]."""
NOISES = 4
"""Times that the noise of the bend angles is drawn."""
BENDS_ON = np.deg2rad(6.0)
"""Rate of a bend from which on it counts [rad/s]: slower, a part of the segment may stick."""
AWAY = 4
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

REST = 40.0
"""Rest without pressure at the end of a run, in which the weight is hung on and taken off [s]."""
FREE = 10.0
"""Time of that rest before the weight is hung on, venting included [s]."""
LEAST_REST = 12.0
"""Least duration of that rest [s]."""
AT_REST = 0.03
"""Share of the largest pressure of a log up to which a limb is without pressure."""
BEFORE = 3.0
"""Time at the beginning of the rest in which the limb must be free [s]."""
HELD = 3.0
"""Time for which the limb must stand still under the weight [s]."""
STILL = np.deg2rad(0.5)
"""Standard deviation of a bend angle of a limb that stands still [rad]."""
LEAST_BEND = np.deg2rad(2.0)
"""Least bend of any segment by the weight [rad]."""
ANGLE_ERROR = np.deg2rad(0.3)
"""Error of that bend, creep included [rad]."""
LEVER_ERROR = 0.04
"""Relative error of the torque, by place and direction of the pull."""


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
    draw, noise = np.random.default_rng(0), _noise(log)
    drawn = [_smooth(log.bend + noise * draw.normal(size=bend.shape)) for _ in range(NOISES)]
    change, deviation = np.zeros(limb.segment_count), np.full(limb.segment_count, np.inf)
    for _ in range(PASSES):
        inertia = _inertia(limb, bend, change)
        added = np.array([[_inertia(limb, each, change) - inertia, each - bend] for each in drawn])
        for i, segment in enumerate(limb.segments):
            rows = counts[:, i]
            if rows.sum() < LEAST_ROWS:
                continue
            angle, own, exact = bend[:, i], pressure[:, i], np.ascontiguousarray(log.bend[:, i])
            friction = [np.sign(rate[:, i]), *(_smooth(dahl(exact, turn)) for turn in TURNS)]
            bent = [angle, np.ones_like(angle), angle**3, angle * np.abs(own), np.abs(own)]
            beside = [pressure[:, j] for j in (i - 1, i + 1) if 0 <= j < limb.segment_count]
            columns = np.column_stack([inertia[:, i], *bent, *friction, *beside, rate])
            (inert, elastic), error = _factors(columns[rows], added[:, :, rows, i], own[rows])
            if min(inert, elastic) > 0.0:
                change[i] = np.log(segment.length * elastic / inert / segment.bending_stiffness)
                deviation[i] = error / inert if error < SURE * inert else np.inf
    return change, deviation


def _noise(log: Prepared) -> Array:
    """Return the standard deviations (M,) of the noise of the bend angles [rad]."""
    apart = np.abs(np.diff(log.bend[log.usable], 4, axis=0)) / np.sqrt(70.0)
    deviation: Array = np.median(apart, axis=0) / 0.6745  # of a normal distribution
    return deviation


def _factors(columns: Array, added: Array, values: Array) -> tuple[Array, float]:
    """Return the first two of the factors that make columns (R, P) values (R,).

    The standard deviation is that of the first one, which is the less certain by far.

    Args:
        columns: as they were seen.
        added: (N, 2, R) what noise, drawn N times, adds to the first two of them.
        values: to make.
    """
    scale, weight = np.abs(columns).max(axis=0, initial=1e-30), np.ones(len(values))
    for _ in range(ROUNDS):
        weighed, noise = weight[:, None] * columns / scale, weight * added / scale[:2, None]
        square = weighed.T @ weighed
        true = square.copy()
        true[:2, :2] -= np.einsum("nar,nbr->ab", noise, noise) / len(noise)
        inverse = np.linalg.pinv(true, hermitian=True)
        factors = inverse @ (weighed.T @ (weight * values)) / scale
        left = values - columns @ factors
        weight = 1.0 / np.hypot(1.0, left / (OUTLYING * np.median(np.abs(left)) + 1e-30))
    # Smoothing makes what is left of so many rows alike.
    variance = 2.0 * np.sqrt(np.pi) * SMOOTHED * np.mean((weight * left) ** 2)
    doubt = (inverse @ square @ inverse)[0, 0]
    return factors[:2], float(np.sqrt(variance * doubt) / scale[0])


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


@dataclass(frozen=True)
class HungWeight:
    """A weight on a limb at rest, as a log shows it.

    Attributes:
        mass: [kg].
        at: where it pulls, along the limb from its clamp [m].
        bends: (2, M) bend angles before and under it [rad].
        pressures: (2, M) in the chambers at the same times [Pa].
        rows: (K,) rows of the log from when it may have been hung on.
        time: from which on the limb stood still under it [s].
    """

    mass: float
    at: float
    bends: Array
    pressures: Array
    rows: NDArray[np.bool_]
    time: float

    def __str__(self) -> str:
        """Return what is known of it, for the report."""
        bent = ", ".join(f"{angle:+.1f}°" for angle in np.degrees(self.bends[1] - self.bends[0]))
        return (
            f"weight: {1000 * self.mass:.3g} g at {1000 * self.at:.0f} mm bent the segments by "
            f"{bent} and held them from {self.time:.1f} s on; their stiffness is by it"
        )

    @classmethod
    def found(cls, log: Prepared, mass: float, at: float) -> HungWeight:
        """Look for the weight in the last rest of a log.

        Args:
            log: prepared.
            mass: of the weight [kg].
            at: where it was hung on [m].

        Raises:
            LogError: the log does not end with such a rest, or the weight hardly bends the limb.
        """
        size = np.abs(log.pressure).max(axis=1)
        edges = np.diff((size <= AT_REST * size.max()).astype(int), prepend=0, append=0)
        stretches = np.flatnonzero(edges).reshape(-1, 2)
        long = stretches[np.diff(stretches, axis=1)[:, 0] >= LEAST_REST / CONTROL_PERIOD]
        if not len(long):
            raise LogError(
                f"no {LEAST_REST:.0f} s without pressure are in the log, in which the weight could "
                "have been hung on: hang it on the resting limb after the run, for ten seconds"
            )
        first, end = (int(row) for row in long[-1])
        free, window = first + round(BEFORE / CONTROL_PERIOD), round(HELD / CONTROL_PERIOD)
        before = log.bend[first + (free - first) // 2 : free].mean(axis=0)
        begins = np.arange(free, end - window)
        held = np.array([log.bend[begin : begin + window].std(axis=0).max() for begin in begins])
        means = np.array([log.bend[begin : begin + window].mean(axis=0) for begin in begins])
        moved = np.where(held < STILL, np.abs(means - before).max(axis=1), 0.0)
        most = int(np.argmax(moved))
        if moved[most] < LEAST_BEND:
            raise LogError(
                f"in the rest at {log.log.time[first]:.0f} s of the log nothing bends a segment by "
                f"{math.degrees(LEAST_BEND):.0f}° and holds it for {HELD:.0f} s: hang on a heavier "
                "weight, or nearer to the tip, once the limb has come to rest; a limb that hangs "
                "straight is hardly bent by it. Without --weight and --at the log is fitted as is"
            )
        under = slice(begins[most], begins[most] + window)
        rows = np.zeros(len(size), dtype=bool)
        rows[free:end] = True
        pressures = np.stack([log.pressure[first:free].mean(axis=0), log.pressure[under].mean(0)])
        bends, held_from = np.stack([before, means[most]]), float(log.log.time[begins[most]])
        return cls(mass, at, bends, pressures, rows, held_from)

    def stiffness_change(self, known: Limb, fitted: Limb) -> tuple[Array, Array]:
        """Return by how much stiffness differs from what was known, and how sure that is.

        Args:
            known: the limb before, with the lengths that were fitted.
            fitted: to the log's motion, whose gain and friction as angles count.

        Returns:
            (M,) logarithms of stiffness over that of ``known``, and their standard deviations;
            infinite where the weight does not move the segment beyond its friction.
        """
        torque = self._torque(fitted)
        change = np.zeros(fitted.segment_count)
        deviation = np.full_like(change, np.inf)
        for index, (segment, old) in enumerate(zip(fitted.segments, known.segments, strict=True)):
            cubic = segment.cubic_stiffness / segment.bending_stiffness / segment.length**2
            driven = self.bends[:, index] - segment.rest_curvature * segment.length
            driven = driven + cubic * driven**3 - segment.static_gain * self.pressures[:, index]
            friction = segment.friction_moment * segment.length / segment.bending_stiffness
            bent = float(driven[1] - driven[0])
            turned = abs(bent) + friction
            if torque[index] * bent > 0.0 and turned > 2.0 * friction + ANGLE_ERROR:
                stiffness = abs(torque[index]) * segment.length / turned
                change[index] = math.log(stiffness / old.bending_stiffness)
                doubt = math.hypot(friction / math.sqrt(3.0), ANGLE_ERROR) / turned
                deviation[index] = math.hypot(doubt, LEVER_ERROR)
        return change, deviation

    def _torque(self, limb: Limb) -> Array:
        """Return the change of torque (M,) on the bends by the weight and by the limb's own."""
        pulled = limb
        if not limb.weighs_in_plane:
            side = math.copysign(GRAVITY, float((self.bends[1] - self.bends[0]).sum()))
            pulled = replace(limb, gravity=(0.0, side, 0.0))
        own, alone = _weights(limb, self.bends), _weights(pulled, self.bends)
        together = _weights(pulled.carrying(self.mass, self.at, name="known weight"), self.bends)
        torque: Array = (together - alone)[1] + own[1] - own[0]
        return torque


def _weights(limb: Limb, bends: Array) -> Array:
    """Return the torques (K, M) [N·m] of a limb's weight on bend angles (K, M) [rad]."""
    arcs = ArcModel(limb)
    torque: Array = arcs.elastic_torque(bends) - arcs.gain * arcs.static_pressure(bends)
    return torque
