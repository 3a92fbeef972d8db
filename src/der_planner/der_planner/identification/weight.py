"""A known weight, hung on the resting limb for some seconds, tells its stiffness without motion.

Pressures and bend angles tell ratios alone: gain over stiffness, friction over gain. A swing tells
stiffness over mass, where friction lets the limb swing. A known force bends the resting limb by

    EI (s(φ₁) − s(φ₀)) / L + f = τ,        s(φ) = φ + k φ³

with φ₀ and φ₁ the bend of a segment beyond that which its pressure gives it, before and under the
weight, τ the torque of the weight, and of the limb's own moved one, on the segment's bend, and f
friction, which has turned against the motion. Friction is known as a bend angle b = f L / EI, so
that EI = τ L / (s(φ₁) − s(φ₀) + b). Before the weight, friction may hold the limb either way: b is
known to b / √3.

A limb that hangs, stands or leaves a wall is pulled along its gravity. One that lies on a plate is
pulled sideways, by a thread that leaves it across the straight limb and runs over a pulley.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from der_planner.arrays import Array
from der_planner.identification.log import LogError, Prepared
from der_planner.limb import Limb
from der_planner.limb.loads import GRAVITY
from der_planner.model import CONTROL_PERIOD, ArcModel

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


@dataclass(frozen=True)
class HungWeight:
    """A weight on a limb at rest, as a log shows it.

    Attributes:
        mass: [kg].
        at: where it pulls, along the limb from its clamp [m].
        bends: (2, M) bend angles before and under it [rad].
        pressures: (2, M) in the chambers at the same times [Pa].
        rows: (K,) rows of the log from when it may have been hung on.
    """

    mass: float
    at: float
    bends: Array
    pressures: Array
    rows: NDArray[np.bool_]

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
                "weight, or nearer to the tip, once the limb has come to rest"
            )
        under = slice(begins[most], begins[most] + window)
        rows = np.zeros(len(size), dtype=bool)
        rows[free:end] = True
        pressures = np.stack([log.pressure[first:free].mean(axis=0), log.pressure[under].mean(0)])
        return cls(mass, at, np.stack([before, means[most]]), pressures, rows)

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
        together = _weights(pulled.carrying(self.mass, self.at), self.bends)
        torque: Array = (together - alone)[1] + own[1] - own[0]
        return torque


def _weights(limb: Limb, bends: Array) -> Array:
    """Return the torques (K, M) [N·m] of a limb's weight on bend angles (K, M) [rad]."""
    arcs = ArcModel(limb)
    torque: Array = arcs.elastic_torque(bends) - arcs.gain * arcs.static_pressure(bends)
    return torque
