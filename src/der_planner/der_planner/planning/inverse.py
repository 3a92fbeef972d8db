"""Inverse kinematics: bend angles for tip positions, by damped least squares on given kinematics.

A limb of two segments reaches most points in two ways, on either side of the fold where the
Jacobian loses its rank (the straight limb lies on that fold). A branch is named by how the last
segment bends compared with the fold: ``counter_clockwise`` or ``clockwise``. All points of a path
are solved in the same matrix operations, each from its own first guess, which decides the branch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import least_squares

from der_planner.limb import Limb
from der_planner.model import ArcModel
from der_planner.model.bending import Kinematics
from der_planner.model.series import interpolate
from der_planner.planning.errors import PlanningError, UnreachableError

Array = NDArray[np.float64]

TOLERANCE = 1e-3
"""Points missed by less than this [m] count as reached (the models' reach differs by less)."""
NEAREST_TOLERANCE = 5e-3
"""The same [m] for a nearest path: along the edge of what arcs reach, a rod's polyline stays behind
by 1 to 2 mm."""
PRIOR_WEIGHT = 1e-5
"""Pull toward the first guess [m/rad]: decides what the tip leaves open (straight limb, M > 2)."""
BRANCHES = ("counter_clockwise", "clockwise")
_ITERATIONS = 60
_SMALLEST_STEP = 1e-11
_LARGEST_STRIDE = 0.15


def solve(
    kinematics: Kinematics, tip: ArrayLike, guess: ArrayLike, prior_weight: float = PRIOR_WEIGHT
) -> tuple[Array, Array]:
    """Return bend angles (K, M) [rad] near the guess and the distances (K,) [m] that remain.

    Minimises |tip(θ) − r|² + w² |θ − guess|² for every point by Levenberg-Marquardt.

    Args:
        kinematics: forward kinematics.
        tip: (K, 2) points r [m].
        guess: (K, M) first guess, which also chooses the branch [rad].
        prior_weight: w [m/rad].
    """
    target = np.atleast_2d(np.asarray(tip, dtype=float))
    prior = np.atleast_2d(np.asarray(guess, dtype=float))
    angles = prior.copy()
    damping = np.full(len(angles), 1e-9)
    identity = np.eye(angles.shape[1])
    weight = prior_weight**2

    def cost(theta: Array) -> Array:
        miss = kinematics.tip(theta) - target
        total: Array = (miss**2).sum(-1) + weight * ((theta - prior) ** 2).sum(-1)
        return total

    present = cost(angles)
    for _ in range(_ITERATIONS):
        miss = kinematics.tip(angles) - target
        jacobian = kinematics.tip_jacobians(angles)
        normal = np.einsum("kai,kaj->kij", jacobian, jacobian)
        normal = normal + (weight + damping)[:, None, None] * identity
        slope = np.einsum("kai,ka->ki", jacobian, miss) + weight * (angles - prior)
        step = -np.linalg.solve(normal, slope[..., None])[..., 0]
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        step = step * np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))
        trial = cost(angles + step)
        better = trial <= present
        angles = np.where(better[:, None], angles + step, angles)
        present = np.where(better, trial, present)
        damping = np.where(better, np.maximum(damping / 10, 1e-16), damping * 10 + 1e-12)
        if np.all(length < _SMALLEST_STEP):
            break
    return angles, np.linalg.norm(kinematics.tip(angles) - target, axis=-1)


def is_loaded(limb: Limb) -> bool:
    """Tell whether gravity bends the limb."""
    return any(limb.gravity)


def static_pressure(limb: Limb, bend_angles: ArrayLike) -> Array:
    """Return the differential pressures (..., M) [Pa] that hold bend angles (..., M) [rad] at rest.

    moment = EI κ' + k₃ κ'³ = G u + gravity's moment, with κ' = θ/L − rest curvature; the limb's
    weight acts on arcs.
    """
    if is_loaded(limb):
        angles = np.asarray(bend_angles, dtype=float)
        flat = angles.reshape(-1, angles.shape[-1])
        held: Array = ArcModel(limb).inverse_dynamics(flat, 0 * flat, 0 * flat)
        return held.reshape(angles.shape)
    lengths = np.array([s.length for s in limb.segments])
    curvature = np.asarray(bend_angles, dtype=float) / lengths
    curvature = curvature - np.array([s.rest_curvature for s in limb.segments])
    moment = np.array([s.bending_stiffness for s in limb.segments]) * curvature
    moment = moment + np.array([s.cubic_stiffness for s in limb.segments]) * curvature**3
    pressure: Array = moment / np.array([s.moment_gain for s in limb.segments])
    return pressure


def check_reach(
    limb: Limb,
    kinematics: Kinematics,
    time: ArrayLike,
    tip: ArrayLike,
    angles: ArrayLike,
    distances: ArrayLike,
    tolerance: float = TOLERANCE,
) -> None:
    """Refuse a path whose points are missed or need more pressure than the limb may have.

    Under gravity only what is missed counts here: what pressures have to hold is for
    `der_planner.planning.loads.overload`.

    Args:
        limb: its `pneumatics.pressure_limit` counts.
        kinematics: that solved the path.
        time: (K,) [s].
        tip: (K, 2) [m].
        angles: (K, M) from `solve` [rad].
        distances: (K,) from `solve` [m].
        tolerance: largest distance that still counts as reached [m].

    Raises:
        UnreachableError: for the first point that fails.
    """
    times, points = np.asarray(time, dtype=float), np.asarray(tip, dtype=float)
    solution, misses = np.asarray(angles, dtype=float), np.asarray(distances, dtype=float)
    limit = limb.pneumatics.pressure_limit
    pressures = np.abs(static_pressure(limb, solution)).max(axis=-1)
    failed = misses > tolerance
    if not is_loaded(limb):
        failed |= pressures > limit
    if not failed.any():
        return
    k = int(np.argmax(failed))
    reached = misses[k] <= tolerance
    distance = distance_to_reach(limb, kinematics, points[k], solution[k])
    raise UnreachableError(
        float(times[k]),
        (float(points[k, 0]), float(points[k, 1])),
        distance,
        float(pressures[k]) if reached else float("nan"),
    )


def distance_to_reach(
    limb: Limb, kinematics: Kinematics, point: ArrayLike, guess: ArrayLike
) -> float:
    """Return the distance [m] from a point to the nearest tip within the pressure limit.

    Bounded least squares from several starts, so that the nearest of the folds' sides counts.
    """
    low, high = angle_limits(limb)
    target = np.asarray(point, dtype=float)

    def miss(theta: Array) -> Array:
        difference: Array = kinematics.tip(theta) - target
        return difference

    starts = [np.clip(np.asarray(guess, dtype=float), low, high)]
    starts += [low + (high - low) * share for share in _corner_shares(limb.segment_count)]
    best = np.inf
    for start in starts:
        result = least_squares(
            miss,
            np.clip(start, low + 1e-9, high - 1e-9),
            jac=kinematics.tip_jacobians,
            bounds=(low, high),
        )
        best = min(best, float(np.linalg.norm(result.fun)))
    return best


def angle_limits(limb: Limb) -> tuple[Array, Array]:
    """Return the least and largest bend angles (M,) [rad] that the pressure limit holds at rest.

    Under gravity they are bounds: as if the whole weight beyond a segment pulled across it.
    """
    limit = limb.pneumatics.pressure_limit
    bounds = []
    for segment, weight in zip(limb.segments, _weight_moments(limb), strict=True):
        moment = segment.moment_gain * limit + weight
        roots = np.roots([segment.cubic_stiffness, 0.0, segment.bending_stiffness, -moment])
        real = roots[np.abs(roots.imag) < 1e-6 * np.abs(roots).max()].real
        positive = real[real > 0]
        curvature = positive.min() if positive.size else moment / segment.bending_stiffness
        bounds.append(
            (
                (segment.rest_curvature - curvature) * segment.length,
                (segment.rest_curvature + curvature) * segment.length,
            )
        )
    low, high = np.array(bounds).T
    if is_loaded(limb):
        return np.maximum(low, -np.pi), np.minimum(high, np.pi)
    return low, high


def _weight_moments(limb: Limb) -> Array:
    """Return the largest moments (M,) of gravity about where each segment starts [N·m]."""
    pull = float(np.hypot(*limb.gravity[:2]))
    if pull == 0:
        return np.zeros(limb.segment_count)
    lengths = np.array([s.length for s in limb.segments])
    starts = np.cumsum(lengths + limb.connector_length) - lengths - limb.connector_length
    mass = np.array([s.mass_per_length for s in limb.segments]) * lengths
    where = np.append(starts + lengths / 2, [m.arc_length - limb.base_length for m in limb.masses])
    mass = np.append(mass, [m.mass for m in limb.masses])
    arms = np.maximum(where - starts[:, None], 0.0)
    moments: Array = pull * arms @ mass
    return moments


def _corner_shares(count: int) -> list[Array]:
    grid = np.array([0.25, 0.75])
    if count > 4:
        return [np.full(count, share) for share in grid]
    mesh = np.meshgrid(*([grid] * count))
    return list(np.stack([axis.ravel() for axis in mesh], axis=-1))


@dataclass(frozen=True)
class Solution:
    """One way to reach a point.

    Attributes:
        bend_angles: (M,) [rad].
        branch: ``counter_clockwise`` or ``clockwise``; empty for M other than 2.
        distance: that remains [m].
        pressure: largest |static differential pressure|, with the weight on arcs [Pa].
    """

    bend_angles: Array
    branch: str
    distance: float
    pressure: float


def branch_of(kinematics: Kinematics, bend_angles: ArrayLike) -> str:
    """Name the branch of a two-segment configuration by the sign of det(∂tip/∂θ).

    det > 0: the last segment bends more counter-clockwise than at the fold.
    """
    jacobian = kinematics.tip_jacobians(bend_angles)
    if jacobian.shape != (2, 2):
        return ""
    return BRANCHES[0] if np.linalg.det(jacobian) > 0 else BRANCHES[1]


def solutions(limb: Limb, kinematics: Kinematics, point: ArrayLike) -> list[Solution]:
    """Return every way found to reach one point within the pressure limit, least pressure first.

    If there is none under gravity, ways beyond the limit are returned: what it takes to hold them
    is for `der_planner.planning.loads.overload`.

    Args:
        limb: for the pressure limit.
        kinematics: forward kinematics.
        point: (2,) [m].
    """
    low, high = angle_limits(limb)
    axis = np.array([0.1, 0.35, 0.5, 0.65, 0.9])
    count = limb.segment_count
    if count <= 3:
        mesh = np.meshgrid(*([axis] * count))
        shares = np.stack([part.ravel() for part in mesh], axis=-1)
    else:
        shares = np.tile(axis[:, None], (1, count))
    starts = low + (high - low) * shares
    target = np.tile(np.asarray(point, dtype=float), (len(starts), 1))
    angles, distances = solve(kinematics, target, starts)
    found: list[Solution] = []
    for theta, distance in zip(angles, distances, strict=True):
        inside = np.all(theta >= low - 1e-9) and np.all(theta <= high + 1e-9)
        if distance > 1e-6 or not inside:
            continue
        if count <= 2 and any(np.linalg.norm(theta - s.bend_angles) < 1e-3 for s in found):
            continue
        pressure = float(np.abs(static_pressure(limb, theta)).max())
        found.append(Solution(theta, branch_of(kinematics, theta), float(distance), pressure))
    limit = limb.pneumatics.pressure_limit * (1 + 1e-6)
    held = [item for item in found if item.pressure <= limit]
    return sorted(held or found, key=lambda item: item.pressure)


def check_branch(branch: str) -> None:
    """Refuse the name of a branch that is neither empty nor one of `BRANCHES`.

    Raises:
        PlanningError: names the choices.
    """
    if branch and branch not in BRANCHES:
        raise PlanningError(f"branch '{branch}' is unknown: choose {' or '.join(BRANCHES)}")


def follow(
    limb: Limb, kinematics: Kinematics, time: ArrayLike, tip: ArrayLike, branch: str = ""
) -> Array:
    """Return bend angles (K, M) [rad] along a path, on one branch, by continuity.

    Args:
        limb: for its pressure limit.
        kinematics: forward kinematics.
        time: (K,) of the points, for messages [s].
        tip: (K, 2) [m].
        branch: at the first point, see `BRANCHES`; empty takes the one with the least pressure.

    Raises:
        UnreachableError: a point is out of reach or beyond the pressure limit.
        PlanningError: unknown branch, or the first point has no solution on it.
    """
    times, points = np.asarray(time, dtype=float), np.asarray(tip, dtype=float)
    check_branch(branch)
    found = solutions(limb, kinematics, points[0])
    if not found:
        middle = np.add(*angle_limits(limb)) / 2 + 0.1
        angles, miss = solve(kinematics, points[:1], middle[None])
        check_reach(limb, kinematics, times[:1], points[:1], angles, miss, tolerance=1e-6)
        start = angles[0]
    else:
        chosen = [item for item in found if not branch or item.branch == branch]
        if not chosen:
            raise PlanningError(
                f"the first point ({points[0, 0]:.4f}, {points[0, 1]:.4f}) m has no solution "
                f"on the branch '{branch}' within the pressure limit, only on '{found[0].branch}'"
            )
        start = chosen[0].bend_angles
    # One by one over every eighth point, all others at once from between them. Where the path is
    # too fast for that, one by one over all.
    for stride in (8, 1):
        anchors = np.unique(np.append(np.arange(0, len(points), stride), len(points) - 1))
        coarse = _continue(kinematics, points[anchors], start)
        if stride == 1 or np.abs(np.diff(coarse, axis=0)).max(initial=0.0) < _LARGEST_STRIDE:
            break
    where = np.arange(len(points))
    guesses = interpolate(where, anchors, coarse)
    angles, misses = solve(kinematics, points, guesses)
    check_reach(limb, kinematics, times, points, angles, misses)
    return angles


def _continue(kinematics: Kinematics, points: Array, start: Array) -> Array:
    """Return bend angles (K, M) along points (K, 2), each from where the last two lead."""
    angles = np.zeros((len(points), len(start)))
    guess = start
    for k, point in enumerate(points):
        angles[k] = solve(kinematics, point[None], guess[None])[0][0]
        guess = 2 * angles[k] - angles[k - 1] if k else angles[k]
    return angles
