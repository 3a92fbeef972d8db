"""The nearest path that a limb can follow, for a drawn path that leaves its reach.

Two segments reach a thin crescent: most lines that a hand draws leave it. Instead of points, bend
angles are sought: any smooth course of them within the pressure limit is one that the limb follows.

1. The drawn line is smoothed in the plane: waves shorter than `DRAWN_WAVE` (or faster than
   `TIMED_WAVE`, if it has times) are a trembling hand's.
2. Dynamic programming over a coarse grid of bend angles finds the course that is nearest to it on
   the whole, so that it neither depends on a first guess nor jumps from one side of the fold to the
   other because a single point is nearer there.
3. A projected Gauss-Newton iteration brings it to the minimum of
   Σ |tip(θ) − r|² + λ Σ |θ''|² within the limits of the bend angles and of the static pressures.
4. It keeps its times, or takes longer where bend angles would change faster than pressures can.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.interpolate import PchipInterpolator
from scipy.linalg import solveh_banded

from der_planner.arrays import Array, interpolate
from der_planner.planning.loads import place_of
from der_planner.planning.paths import TipPath
from der_planner.planning.timing import PathLimits, retimed
from der_planner.planning.workspace import Workspace

DRAWN_WAVE = 0.01
"""Waves of a line without times that are shorter than this [m] are smoothed to less than half."""
TIMED_WAVE = 0.25
"""Waves of a path with times that are shorter than this [s] are smoothed to less than half."""
PACE = 0.03
"""A line without times is sampled as if the tip went along it at this speed [m/s]."""
RESERVE = 0.03
"""Share of the pressure limit that the nearest path leaves: models differ by about this much."""
NOTABLE = 1e-3
"""From this distance on [m] the drawn line counts as left."""
_PLACE = 1e-6
"""A drawing smaller than this [m] is one place."""
_STILL = 15
"""Instants of rest before and after a path that begins and ends at rest, 20 ms each."""
_SAMPLE = 0.05
"""Time between two instants at which the nearest path is searched for [s]."""
_MOST_SAMPLES = 20_000
"""Largest number of these instants."""
_MOST_AVERAGED = 50
"""Largest number of drawn points whose mean stands for one instant."""
_WAYPOINTS = 200
"""Largest number of points that the coarse search passes."""
_STATES = 2500
"""Poses of the limb among which the coarse search chooses at each point."""
_TRAVEL = 1e-5
"""Weight of (rad/s)² against m² in the coarse search: it keeps the course from jumping."""
_PRESSURE = 1e-4
"""Weight of (pressure over its limit)² [m²] that decides between equally near courses."""
_WEAKEST = 0.08
"""Movement of the tip per radian of bend, over the limb's length.

Where the tip moves less, waves of `TIMED_WAVE` are smoothed rather than followed.
"""
_EXCESS = 1.0
"""Weight of what is beyond a limit, relative to it [m]."""
_ITERATIONS = 60
"""Largest number of steps of the fine search."""


@dataclass(frozen=True)
class Deviation:
    """How far the nearest path is from the drawn one, point by point.

    Attributes:
        largest: distance [m].
        mean: distance over the drawn path's time, or over its length if it has no times [m].
        time: when the nearest path is farthest, after its first point [s].
        point: (2,) of the drawn path there [m].
        share: of the drawn path from which it is `NOTABLE` away or more, 0 … 1.
        slowed: duration over the drawn path's; 1 if it kept its times, NaN if it had none.
    """

    largest: float
    mean: float
    time: float
    point: Array
    share: float
    slowed: float

    def __str__(self) -> str:
        """Return a sentence for people; empty if the drawn path is followed as it is."""
        parts = []
        if self.largest >= NOTABLE:
            parts.append(
                f"the nearest path leaves {self.share * 100:.0f} % of the drawn one: it is "
                f"{self.mean * 1000:.1f} mm away on average and {self.largest * 1000:.1f} mm at "
                f"most, near {place_of(self.point)}, {self.time:.1f} s after its first point"
            )
        if self.slowed > 1.001:
            parts.append(
                f"the path takes {self.slowed:.2f} times as long as drawn, since pressures cannot "
                "change faster"
            )
        return "; ".join(parts)


def nearest_path(
    workspace: Workspace,
    path: TipPath,
    offset: Array,
    limits: PathLimits | None = None,
    rest: bool = False,
) -> tuple[Array, Array, Deviation]:
    """Return the nearest path that the limb can follow, and how far it is from the drawn one.

    The path is its instants (K,) from 0 on [s] and its bend angles (K, M) [rad].

    Args:
        workspace: of the limb.
        path: drawn; its times are kept where the slew limit lets them.
        offset: (2,) of the limb's tip from that of the arcs, where loads make it [m].
        limits: speed and acceleration of the tip, for a path whose times mean nothing (`line`).
        rest: begin and end a path with times at rest, too.
    """
    samples = int(np.clip(math.ceil(path.duration / _SAMPLE), 16, _MOST_SAMPLES)) + 1
    time, drawn = _sampled(path, samples)
    step = float(time[1])
    wave = TIMED_WAVE if limits is None else DRAWN_WAVE / PACE
    wanted = drawn.mean(axis=1)
    target = _smoothed(wanted - offset, step, wave)
    angles = _Search(workspace, target, step).run()
    # Without overshoot where the course hurries along a limit; what is left of corners goes after.
    course = PchipInterpolator(time, angles)
    clock, along = retimed(workspace, course, path.duration, limits, rest)
    if limits is not None or rest:
        still = np.zeros(_STILL)
        along = np.concatenate([still, along, still + path.duration])
        clock = np.arange(len(along)) * clock[1]
    followed = _smoothed(course(along), float(clock[1]), TIMED_WAVE)
    distance = np.linalg.norm(wanted - workspace.arcs.tip(angles) - offset, axis=-1)
    farthest = int(distance.argmax())
    deviation = Deviation(
        largest=float(distance[farthest]),
        mean=float(distance.mean()),
        time=float(np.interp(time[farthest], along, clock)),
        point=wanted[farthest],
        share=float((distance >= NOTABLE).mean()),
        slowed=math.nan if limits is not None else float(clock[-1] / path.duration),
    )
    return clock, followed, deviation


def line(tip: Array) -> TipPath:
    """Return points (P, 2) [m] without times as a path at a steady pace; one place: rest for 1 s.

    Its length is measured with a ruler of a quarter of `DRAWN_WAVE`, less for a small drawing: the
    steps of a trembling hand would make it many times as long.
    """
    extent = float(np.linalg.norm(np.ptp(tip, axis=0)))
    if extent < _PLACE:
        return TipPath(np.array([0.0, 1.0]), np.repeat(tip[:1], 2, axis=0))
    ruler = min(DRAWN_WAVE / 4, extent / 20)
    kept = [0]
    for k in range(1, len(tip)):
        if math.dist(tip[k], tip[kept[-1]]) >= ruler:
            kept.append(k)
    if kept[-1] != len(tip) - 1:
        kept.append(len(tip) - 1)
    steps = np.maximum(np.linalg.norm(np.diff(tip[kept], axis=0), axis=1), ruler / 10)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    return TipPath(np.interp(np.arange(len(tip)), kept, arc) / PACE, tip)


def _sampled(path: TipPath, samples: int) -> tuple[Array, Array]:
    """Return evenly spaced instants (K,) and the drawn points around each of them (K, A, 2)."""
    time = np.linspace(0.0, path.duration, samples)
    each = int(np.clip(math.ceil(len(path.time) / samples), 1, _MOST_AVERAGED))
    offsets = ((np.arange(each) + 0.5) / each - 0.5) * time[1]
    fine = np.clip(time[:, None] + offsets, 0.0, path.duration)
    # Without overshoot, whatever the points' spacing.
    drawn: Array = PchipInterpolator(path.time, path.tip)(fine)
    return time, drawn


def _smoothed(points: Array, step: float, wave: float) -> Array:
    """Return points (K, 2), `step` apart, with waves of length `wave` at half of their height."""
    weight = (wave / (2 * np.pi * step)) ** 4
    differences = _second_differences(len(points))
    band = weight * _banded(differences.T @ differences, 3)
    band[0] += 1.0
    return solveh_banded(band, points, lower=True)


def _second_differences(count: int) -> sparse.csr_array:
    """Return the matrix (K − 2, K) of second differences."""
    offsets, shape = [0, 1, 2], (count - 2, count)
    return sparse.diags_array([1.0, -2.0, 1.0], offsets=offsets, shape=shape, format="csr")


def _banded(matrix: sparse.csr_array, rows: int) -> Array:
    """Return the lower band (rows, n) of a symmetric matrix, as `solveh_banded` takes it."""
    return np.stack([np.pad(matrix.diagonal(-k), (0, k)) for k in range(rows)])


class _Search:
    """Finds the bend angles (K, M) whose tips are nearest to (K, 2) targets, `step` [s] apart."""

    def __init__(self, workspace: Workspace, target: Array, step: float) -> None:
        self._kinematics = workspace.arcs
        self._target, self._step, self._count = target, step, workspace.limb.segment_count
        middle = (workspace.low + workspace.high) / 2
        half = (workspace.high - workspace.low) / 2 * (1 - RESERVE)
        self._low, self._high = middle - half, middle + half
        self._limit = workspace.pressure_limit * (1 - RESERVE)
        weakest = _WEAKEST * workspace.limb.length
        smoothing = sparse.kron(_second_differences(len(target)), sparse.eye_array(self._count))
        self._smoothing = weakest * (TIMED_WAVE / (2 * np.pi * step)) ** 2 * smoothing.tocsr()

    def run(self) -> Array:
        """Search coarsely, then finely."""
        where = np.linspace(0, len(self._target) - 1, min(_WAYPOINTS, len(self._target))).round()
        chosen = where.astype(int)
        coarse = self._coarse(self._target[chosen], float(where[1]) * self._step)
        return self._fine(interpolate(np.arange(len(self._target)), where, coarse))

    def _coarse(self, target: Array, step: float) -> Array:
        """Return the states of a grid (K, M) [rad] that follow the target best on the whole."""
        count = self._count
        size = max(3, round(_STATES ** (1 / count)) if count > 1 else 200)
        axes = [np.linspace(a, b, size) for a, b in zip(self._low, self._high, strict=True)]
        states = np.stack([part.ravel() for part in np.meshgrid(*axes, indexing="ij")], axis=-1)
        tips, own = self._kinematics.tip(states), self._price(states)
        travel = [_TRAVEL / step * (axis[:, None] - axis) ** 2 for axis in axes]
        costs = [step * (((tips - point) ** 2).sum(-1) + own) for point in target]
        # The least cost to come to each state, point by point; going along one axis at a time.
        totals = [costs[0]]
        for cost in costs[1:]:
            total = totals[-1].reshape((size,) * count)
            for axis in range(count):
                arriving = np.moveaxis(total, axis, -1)[..., None, :] + travel[axis]
                total = np.moveaxis(arriving.min(axis=-1), -1, axis)
            totals.append(total.ravel() + cost)
        course = [int(np.argmin(totals[-1]))]
        for total in totals[-2::-1]:
            way = _TRAVEL / step * ((states - states[course[-1]]) ** 2).sum(-1)
            course.append(int(np.argmin(total + way)))
        return states[course[::-1]]

    def _price(self, states: Array) -> Array:
        """Return what a state (G, M) costs wherever the tip should be [m²]."""
        share = np.abs(self._kinematics.static_pressure(states)) / self._limit
        price: Array = _PRESSURE * _WEAKEST**2 * (share**2).sum(-1)
        return price + (share > 1).any(-1)

    def _fine(self, angles: Array) -> Array:
        """Return the angles (K, M) at the minimum that lies nearest to the given ones."""
        damping, missed = 1e-6, self._misses(angles)
        for _ in range(_ITERATIONS):
            slopes = self._slopes(angles)
            slope = (slopes.T @ missed).reshape(angles.shape)
            tied = ((angles <= self._low) & (slope > 0)) | ((angles >= self._high) & (slope < 0))
            # An angle that a limit holds changes nothing, and stays.
            slopes = slopes @ sparse.diags_array((~tied).ravel().astype(float))
            band = _banded(slopes.T @ slopes, 2 * self._count + 1)
            band[0] += tied.ravel()
            while damping < 1e3:
                matrix = band.copy()
                matrix[0] += damping * max(float(band[0].max()), 1e-12)
                step = solveh_banded(matrix, np.where(tied, 0.0, -slope).ravel(), lower=True)
                moved = np.clip(angles + step.reshape(angles.shape), self._low, self._high)
                new = self._misses(moved)
                if new @ new <= missed @ missed:
                    break
                damping *= 10
            else:
                break
            gain, change = missed @ missed - new @ new, np.abs(moved - angles).max()
            angles, missed, damping = moved, new, max(damping / 10, 1e-9)
            if change < 1e-6 or gain <= 1e-7 * (new @ new):
                break
        return angles

    def _excess(self, angles: Array) -> Array:
        """Return what poses (K, M) have beyond the pressure limit (K, M) [m]."""
        pressure = self._kinematics.static_pressure(angles) / self._limit
        beyond: Array = _EXCESS * np.sign(pressure) * np.maximum(np.abs(pressure) - 1, 0.0)
        return beyond

    def _misses(self, angles: Array) -> Array:
        """Return what is to be small: pose by pose tip (2) and excess (M) [m], then all bends."""
        missed = self._kinematics.tip(angles) - self._target
        near = np.concatenate([missed, self._excess(angles)], axis=1)
        return np.concatenate([near.ravel(), self._smoothing @ angles.ravel()])

    def _slopes(self, angles: Array) -> sparse.csr_array:
        """Return ∂(misses)/∂(angles)."""
        count, inputs = angles.shape
        by_angle = np.zeros((count, inputs, inputs))
        beyond = self._excess(angles)
        if beyond.any():
            nudge = 1e-6 * np.eye(inputs)
            columns = [(self._excess(angles + part) - beyond) / 1e-6 for part in nudge]
            by_angle = np.stack(columns, axis=-1)
        blocks = np.concatenate([self._kinematics.tip_jacobians(angles), by_angle], axis=1)
        near = sparse.bsr_array((blocks, np.arange(count), np.arange(count + 1)))
        return sparse.csr_array(sparse.vstack([near, self._smoothing]))
