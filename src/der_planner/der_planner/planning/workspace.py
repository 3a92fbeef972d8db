"""What a limb reaches within its pressure limit, and where it rests.

A limb of two segments reaches most points in two ways, on either side of the fold where the
Jacobian loses its rank (the straight limb lies on that fold). A branch is named by how the last
segment bends compared with the fold: ``counter_clockwise`` or ``clockwise``. All points of a path
are solved in the same matrix operations, each from its own first guess, which decides the branch.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from der_planner.arrays import Array, interpolate
from der_planner.model import NODES, ArcModel, Model, RodModel
from der_planner.model.bending import Kinematics, inverse_kinematics
from der_planner.model.rod import PoseFinder
from der_planner.planning.loads import PlanningError, held_poses, place_of, stable_rest

TOLERANCE = 1e-3
"""Points missed by less than this [m] count as reached (the models' reach differs by less)."""
NEAREST_TOLERANCE = 5e-3
"""The same [m] for a nearest path: along the edge of what arcs reach, a rod's polyline stays behind
by 1 to 2 mm."""
BRANCHES = ("counter_clockwise", "clockwise")
"""Names of the two ways in which two segments reach a point."""
POSE_PERIOD = 0.1
"""Time between two poses of a loaded rod [s]."""
_STRAIGHT = 1e-3
"""A limb that rests within this bend of straight starts there [rad]."""
_LARGEST_STRIDE = 0.15
"""Change of a bend angle between anchors of a path up to which what lies between is safe [rad]."""


@dataclass(eq=False)
class UnreachableError(PlanningError):
    """A point of the path lies outside what the limb reaches within its pressure limit.

    Attributes:
        time: of the point in the motion [s].
        point: (2,) in `limb_base` [m].
        distance: to the nearest reachable point [m].
        required_pressure: largest |differential pressure| the point would need [Pa]; NaN where no
            pressure reaches it.
        carried: what the limb carries under gravity [kg].
    """

    time: float
    point: Array
    distance: float
    required_pressure: float
    carried: float = 0.0

    def __str__(self) -> str:
        """Return a sentence for people, with the remedy."""
        needed = "no pressure reaches it"
        if not math.isnan(self.required_pressure):
            needed = f"it would need {self.required_pressure / 1000:.1f} kPa"
        carries = f"It carries {self.carried * 1000:.1f} g: carry less, move"
        return (
            f"the point {place_of(self.point)} at t = {self.time:.2f} s is "
            f"out of reach: {self.distance * 1000:.1f} mm from what the limb reaches within its "
            f"pressure limit; {needed}. {carries if self.carried else 'Move'} or shrink the path "
            "(a named motion: by its amplitude, in rad), or follow the nearest path that the limb "
            "can (nearest=True; --nearest)"
        )


@dataclass(frozen=True)
class Solution:
    """One way to reach a point.

    Attributes:
        bend_angles: (M,) [rad].
        branch: ``counter_clockwise`` or ``clockwise``; empty for M other than 2.
        pressure: largest |static differential pressure|, with the weight on arcs [Pa].
    """

    bend_angles: Array
    branch: str
    pressure: float


@dataclass(frozen=True)
class Rest:
    """The pose in which a vented limb rests, as bend angles of arcs with the rod's tip.

    Attributes:
        bend_angles: (M,) under the loads [rad].
        bend_by_load: (M,) what the loads alone add to the bend without loads [rad].
        offset: (2,) of the rod's tip from that of these arcs [m]: stretch, and what arcs cannot do.
    """

    bend_angles: Array
    bend_by_load: Array
    offset: Array


class Workspace:
    """What one limb reaches as arcs.

    Args:
        model: of the limb.
        share: of its pressure limit that may be used.

    Attributes:
        limb: of the model.
        arcs: constant-curvature arcs of its segments.
        is_loaded: whether gravity bends it.
        sags: whether it sags out of its plane of motion.
        pressure_limit: largest |differential pressure| [Pa].
        fastest: (M,) rates of the bend angles at the slew limit [rad/s].
        low, high: (M,) least and largest bend angles that the pressure limit holds at rest [rad].
            Under gravity they are bounds: as if the whole weight beyond a segment pulled across it.
    """

    def __init__(self, model: Model, share: float = 1.0) -> None:
        limb = model.limb
        self._model, self.limb, self.is_loaded = model, limb, model.is_loaded
        self.arcs = model if isinstance(model, ArcModel) else ArcModel(limb)
        self.sags = limb.gravity[2] != 0
        self.pressure_limit = share * limb.pneumatics.pressure_limit
        self.fastest = limb.pneumatics.slew_limit * limb.static_gain
        self.low, self.high = self._angle_limits()

    @cached_property
    def rod(self) -> RodModel:
        """The limb's rod with the usual number of nodes."""
        if isinstance(self._model, RodModel) and self._model.nodes == NODES:
            return self._model
        return RodModel(self.limb)

    @cached_property
    def rest(self) -> Rest:
        """Where the vented limb rests.

        Raises:
            BucklingError: it does not stay there.
        """
        own = self.arcs.free_angles
        if np.abs(own).max() < _STRAIGHT:
            own = np.zeros_like(own)
        if not self.is_loaded:
            return Rest(own, np.zeros_like(own), np.zeros(2))
        state = stable_rest(self.rod)
        angles = inverse_kinematics(self.arcs, state.q[None, -3:-1], self.rod.bend_of(state))[0][0]
        if np.abs(angles).max() < _STRAIGHT:
            angles = np.zeros_like(angles)
        return Rest(angles, angles - own, state.q[-3:-1] - self.arcs.tip(angles))

    def sagging_tips(self, time: Array, angles: Array) -> Array:
        """Return the tips (K, 2) [m] of the rod in space that bends by angles (K, M) [rad].

        A level limb that is free to sag under gravity along −z comes less far out than arcs of its
        length say. Its reference is the tip of the rod in space, held by pressures so that its
        segments bend by the motion's angles, as seen along z.

        Args:
            time: (K,) for messages [s].
            angles: of the motion; the rod rests where the arcs do.

        Raises:
            BucklingError: the rod does not stay on the way.
        """
        state = stable_rest(self.rod)
        count = max(8, math.ceil((time[-1] - time[0]) / POSE_PERIOD) + 1)
        instants = np.linspace(time[0], time[-1], count)
        beside = self.rod.bend_of(state) - self.rest.bend_angles
        wanted = interpolate(instants, time, angles) + beside
        finder = PoseFinder(self.rod, prior=1.0, tip_weight=0.0)
        poses = held_poses(finder, state, instants, self.arcs.tip(wanted), wanted)
        tips = np.array([state.q[-3:-1] for state in poses.states])
        return make_interp_spline(instants, tips, k=5)(time)

    def _angle_limits(self) -> tuple[Array, Array]:
        bounds = []
        for segment, weight in zip(self.limb.segments, self._weight_moments(), strict=True):
            moment = segment.moment_gain * self.pressure_limit + weight
            roots = np.roots([segment.cubic_stiffness, 0.0, segment.bending_stiffness, -moment])
            real = roots[np.abs(roots.imag) < 1e-6 * np.abs(roots).max()].real
            positive = real[real > 0]
            curvature = positive.min() if positive.size else moment / segment.bending_stiffness
            around = segment.rest_curvature + np.array([-curvature, curvature])
            bounds.append(around * segment.length)
        low, high = np.array(bounds).T
        if self.is_loaded:
            return np.maximum(low, -np.pi), np.minimum(high, np.pi)
        return low, high

    def _weight_moments(self) -> Array:
        """Return the largest moments (M,) of gravity about where each segment starts [N·m]."""
        parts = self.arcs.arcs
        starts = np.cumsum(parts.lengths + parts.connector) - parts.lengths - parts.connector
        where = starts[parts.owner] + parts.place * parts.lengths[parts.owner] + parts.beyond
        arms = np.maximum(where - starts[:, None], 0.0)
        moments: Array = np.hypot(*parts.gravity) * arms @ parts.weight
        return moments

    def check_reach(
        self,
        time: Array,
        tip: Array,
        angles: Array,
        misses: Array,
        tolerance: float = TOLERANCE,
        kinematics: Kinematics | None = None,
    ) -> None:
        """Refuse a path whose points are missed or need more pressure than the limb may have.

        Under gravity only what is missed counts here: what pressures have to hold is for
        `der_planner.planning.loads`.

        Args:
            time: (K,) [s].
            tip: (K, 2) [m].
            angles: (K, M) from `inverse_kinematics` [rad].
            misses: (K,) distances from `inverse_kinematics` [m].
            tolerance: largest distance that still counts as reached [m].
            kinematics: that solved the path; None: the arcs.

        Raises:
            UnreachableError: for the first point that fails.
        """
        pressures = np.abs(self.arcs.static_pressure(angles)).max(axis=-1)
        failed = misses > tolerance
        if not self.is_loaded:
            failed |= pressures > self.pressure_limit
        if not failed.any():
            return
        k = int(np.argmax(failed))
        reached = misses[k] <= tolerance
        raise UnreachableError(
            float(time[k]),
            tip[k],
            self.distance_to_reach(tip[k], angles[k], kinematics),
            float(pressures[k]) if reached else float("nan"),
        )

    def distance_to_reach(
        self, point: ArrayLike, guess: ArrayLike, kinematics: Kinematics | None = None
    ) -> float:
        """Return the distance [m] from a point to the nearest tip within the pressure limit.

        The search has several starts, so that the nearest of the folds' sides counts.
        """
        starts = np.vstack([guess, self._grid(np.array([0.25, 0.75]), 4)])
        target = np.tile(np.asarray(point, dtype=float), (len(starts), 1))
        limits = (self.low, self.high)
        return float(
            inverse_kinematics(kinematics or self.arcs, target, starts, bounds=limits)[1].min()
        )

    def _grid(self, shares: Array, most: int) -> Array:
        """Return bend angles (P, M) [rad] at shares of the limits, of limbs with few segments all.

        With more than ``most`` segments all segments have the same share.
        """
        count = len(self.low)
        table = np.tile(shares[:, None], (1, count))
        if count <= most:
            mesh = np.meshgrid(*([shares] * count))
            table = np.stack([part.ravel() for part in mesh], axis=-1)
        return self.low + (self.high - self.low) * table

    def solutions(self, point: ArrayLike) -> list[Solution]:
        """Return every way found to reach one point within the limit, least pressure first.

        If there is none under gravity, ways beyond the limit are returned: what it takes to hold
        them is for `der_planner.planning.loads`.

        Args:
            point: (2,) [m].
        """
        starts = self._grid(np.array([0.1, 0.35, 0.5, 0.65, 0.9]), 3)
        target = np.tile(np.asarray(point, dtype=float), (len(starts), 1))
        found: list[Solution] = []
        for theta, distance in zip(*inverse_kinematics(self.arcs, target, starts), strict=True):
            inside = np.all(theta >= self.low - 1e-9) and np.all(theta <= self.high + 1e-9)
            known = (np.linalg.norm(theta - item.bend_angles) < 1e-3 for item in found)
            if distance > 1e-6 or not inside or (len(theta) <= 2 and any(known)):
                continue
            pressure = float(np.abs(self.arcs.static_pressure(theta)).max())
            found.append(Solution(theta, branch_of(self.arcs, theta), pressure))
        limit = self.pressure_limit * (1 + 1e-6)
        possible = [item for item in found if item.pressure <= limit]
        return sorted(possible or found, key=lambda item: item.pressure)

    def follow(self, time: Array, tip: Array, branch: str = "") -> Array:
        """Return bend angles (K, M) [rad] of arcs along a path, on one branch, by continuity.

        Args:
            time: (K,) of the points, for messages [s].
            tip: (K, 2) [m].
            branch: at the first point, see `BRANCHES`; empty takes the one with the least
                pressure.

        Raises:
            UnreachableError: a point is out of reach or beyond the pressure limit.
            PlanningError: unknown branch, or the first point has no solution on it.
        """
        start = self._begin(time, tip, branch)
        # One by one over every eighth point, all others at once from between them. Where the path
        # is too fast for that, one by one over all.
        for stride in (8, 1):
            anchors = np.unique(np.append(np.arange(0, len(tip), stride), len(tip) - 1))
            coarse = self._continue(tip[anchors], start)
            if stride == 1 or np.abs(np.diff(coarse, axis=0)).max(initial=0.0) < _LARGEST_STRIDE:
                break
        guesses = interpolate(np.arange(len(tip)), anchors, coarse)
        angles, misses = inverse_kinematics(self.arcs, tip, guesses)
        self.check_reach(time, tip, angles, misses)
        return angles

    def _begin(self, time: Array, tip: Array, branch: str) -> Array:
        """Return the bend angles (M,) [rad] at the first point of a path, see `follow`."""
        check_branch(branch)
        found = self.solutions(tip[0])
        if not found:
            middle = (self.low + self.high) / 2 + 0.1
            angles, miss = inverse_kinematics(self.arcs, tip[:1], middle[None])
            self.check_reach(time[:1], tip[:1], angles, miss, tolerance=1e-6)
            first: Array = angles[0]
            return first
        for item in found:
            if branch in ("", item.branch):
                return item.bend_angles
        raise PlanningError(
            f"the first point {place_of(tip[0])} has no solution on the branch "
            f"'{branch}' within the pressure limit, only on '{found[0].branch}'"
        )

    def _continue(self, points: Array, start: Array) -> Array:
        """Return bend angles (K, M) along points (K, 2), each from where the last two lead."""
        angles, guess = np.zeros((len(points), len(start))), start
        for k, point in enumerate(points):
            angles[k] = inverse_kinematics(self.arcs, point[None], guess[None])[0][0]
            # What a point leaves open of more than two segments would drift on for ever.
            guess = 2 * angles[k] - angles[k - 1] if k and len(start) <= 2 else angles[k]
        return angles


def branch_of(kinematics: Kinematics, bend_angles: ArrayLike) -> str:
    """Name the branch of a two-segment configuration by the sign of det(∂tip/∂θ).

    det > 0: the last segment bends more counter-clockwise than at the fold.
    """
    jacobian = kinematics.tip_jacobians(bend_angles)
    if jacobian.shape != (2, 2):
        return ""
    return BRANCHES[0] if np.linalg.det(jacobian) > 0 else BRANCHES[1]


def check_branch(branch: str) -> None:
    """Refuse the name of a branch that is neither empty nor one of `BRANCHES`.

    Raises:
        PlanningError: names the choices.
    """
    if branch and branch not in BRANCHES:
        raise PlanningError(f"branch '{branch}' is unknown: choose {' or '.join(BRANCHES)}")
