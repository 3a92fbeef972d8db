"""Things in the way of a limb: how far a motion keeps from them, with what force it touches.

A file names circles and half-planes in `limb_base`, in metres and newtons:

    limb_radius_m: 0.015
    obstacles:
      - {circle_m: [0.12, 0.10], radius_m: 0.01, allowed_force_n: 0.2}
      - {half_plane_m: [0.0, -0.08], normal: [0, 1]}       # the limb stays where the normal points

The clearance of a pose is the distance of its centreline from an obstacle less both radii. Where it
is negative, the limb does not come so far: what does not move pushes it back by that much, with the
force that the compliance there gives, f = −clearance / (nᵀ C_p n). A motion for which this is more
than an obstacle allows is refused, or, by the method ``optimal``, led past it first (`led_past`).
So is one in which the limb would come out on the obstacle's other side, whatever is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import piqp
from scipy import sparse

from der_planner.arrays import Array
from der_planner.files import read_yaml
from der_planner.model import CONTROL_PERIOD, RodModel
from der_planner.model.compliance import compliance
from der_planner.planning.loads import PlanningError, place_of
from der_planner.planning.timing import SLEW_SHARE

_CIRCLE = {"circle_m", "radius_m", "allowed_force_n"}
_HALF_PLANE = {"half_plane_m", "normal", "allowed_force_n"}
_FINE = 4
"""Points a piece of the centreline between two nodes."""
_LARGE = 1e4
"""Radius of a circle whose edge is straight beside a limb [m]."""
_MARGIN = 3e-3
"""Distance that poses keep beside what is allowed [m]."""
_BESIDE = 3e-2
"""Points this far from where they may be are kept from coming nearer than that [m]."""
_NEARNESS = 1e-3
"""Tip error that a change of a bend angle is worth [m/rad]."""
_SMOOTH = 1.0
"""Tip error that a second difference of this change from pose to pose is worth [m/rad]."""
_PART = 30.0
"""Tip error that a distance which is lacking is worth."""
_STEP = 0.1
"""Largest change of a bend angle at a time [rad]."""
_OTHER_UNIT = 10.0
"""Distance from the clamp, over the limb's length, and force, over what the limb's tip presses with
at most, beyond which a number has another unit."""


@dataclass(frozen=True)
class Obstacle:
    """A circle; a half-plane is one so large that its edge is straight beside a limb.

    Attributes:
        centre: (2,) [m].
        radius: [m].
        allowed_force: with which the limb may touch it [N].
        name: for people, with its place.
    """

    centre: Array
    radius: float
    allowed_force: float
    name: str

    def away(self, points: Array) -> tuple[Array, Array]:
        """Return the distances (…,) of points (…, 2) [m] and the directions (…, 2) out of it."""
        between = points - self.centre
        distance = np.linalg.norm(between, axis=-1)
        return distance - self.radius, between / np.maximum(distance, 1e-12)[..., None]


@dataclass(eq=False)
class ObstacleError(PlanningError):
    """A motion would touch an obstacle with more force than that allows.

    Attributes:
        time: when it would be worst [s].
        place: along the limb from its clamp [m].
        clearance: there, negative [m].
        force: that it would take [N]; infinite where none brings it about.
        obstacle: which one.
    """

    time: float
    place: float
    clearance: float
    force: float
    obstacle: Obstacle

    def __str__(self) -> str:
        """Return a sentence for people."""
        with_force = (
            f"with {self.force:.2f} N ({self.obstacle.allowed_force:.2f} N are allowed)"
            if math.isfinite(self.force)
            else "which no force brings about"
        )
        return (
            f"at t = {self.time:.2f} s the limb would run {-self.clearance * 1000:.1f} mm into "
            f"{self.obstacle.name}, {self.place * 100:.1f} cm from its clamp, {with_force}: shrink "
            "or move the motion"
        )


@dataclass(frozen=True)
class Nearest:
    """Where a motion comes nearest to an obstacle.

    Attributes:
        clearance: [m]; negative: it would run into it.
        index: of the pose.
        place: along the limb from its clamp [m].
        out: (2,) direction out of the obstacle.
        passes: whether the limb would come out of the obstacle on the other side.
    """

    clearance: float
    index: int
    place: float
    out: Array
    passes: bool


@dataclass(frozen=True)
class Obstacles:
    """All that is in the way of one limb.

    Attributes:
        limb_radius: of the limb [m].
        items: the obstacles.
    """

    limb_radius: float
    items: tuple[Obstacle, ...]

    @staticmethod
    def from_yaml(path: str | Path) -> Obstacles:
        """Read a file, see the module.

        Raises:
            PlanningError: the file cannot be read or says something else; names it.
        """
        content = read_yaml(path, "the file of obstacles", PlanningError)
        try:
            return Obstacles.from_mapping(content)
        except (ValueError, TypeError, KeyError) as error:
            raise PlanningError(f"{path} cannot be used as a file of obstacles: {error}") from error

    @staticmethod
    def from_mapping(content: Any) -> Obstacles:
        """Return what a file's content says.

        Raises:
            ValueError: a key is unknown or missing, or a number is not one that can be.
        """
        if not isinstance(content, Mapping) or set(content) != {"limb_radius_m", "obstacles"}:
            found = ", ".join(map(str, content)) if isinstance(content, Mapping) else content
            raise ValueError(f"the two keys limb_radius_m and obstacles are expected, got {found}")
        items = tuple(_obstacle(item) for item in content["obstacles"] or ())
        return Obstacles(_number(content["limb_radius_m"], "limb_radius_m"), items)

    @property
    def circles(self) -> Array:
        """(P, 3) centre and radius of each [m]."""
        return np.array([(*each.centre, each.radius) for each in self.items]).reshape(-1, 3)

    def nearest(self, obstacle: Obstacle, curves: Array) -> Nearest:
        """Return where poses come nearest to an obstacle.

        Args:
            obstacle: of these.
            curves: (K, P, 2) centrelines from the clamp on [m].
        """
        points = _fine(curves)
        distance, out = obstacle.away(points)
        clearance = distance.min(axis=1) - self.limb_radius
        closest = distance.argmin(axis=1)
        k = int(clearance.argmin())
        along = np.linalg.norm(np.diff(points[k], axis=0), axis=1)[: closest[k]].sum()
        # Between two poses inside, the side on which the limb leaves it changes.
        sides = out[np.arange(len(out)), closest]
        inside = (clearance[:-1] < 0.0) & (clearance[1:] < 0.0)
        passes = bool(np.any(inside & (np.sum(sides[:-1] * sides[1:], axis=1) < 0.0)))
        return Nearest(float(clearance[k]), k, float(along + points[k, 0, 0]), sides[k], passes)

    def check_rest(self, model: RodModel, curve: Array, bend: Array) -> None:
        """Refuse numbers in another unit, and obstacles where the limb rests.

        Args:
            model: rod of the limb.
            curve: (P, 2) its centreline at rest [m].
            bend: (M,) of it [rad].

        Raises:
            PlanningError: names what cannot be, and the remedy.
        """
        length, force = model.limb.length, model.limb.tip_force
        for each in self.items:
            if each.allowed_force > _OTHER_UNIT * force:
                raise PlanningError(
                    f"{each.name} may be touched with {each.allowed_force:g} N, and the tip "
                    f"presses with some {force:.2g} N at most: give N"
                )
            if abs(each.away(np.zeros(2))[0]) > _OTHER_UNIT * length:
                raise PlanningError(
                    f"{each.name} in the file of obstacles is far too large for a limb of "
                    f"{length:.3g} m: give all lengths in metres"
                )
        try:
            self.check(model, np.zeros(1), curve[None], bend[None])
        except ObstacleError as error:
            raise PlanningError(
                f"the resting limb is {-error.clearance * 1000:.1f} mm inside "
                f"{error.obstacle.name}, {error.place * 100:.1f} cm from its clamp: give its "
                "place in metres from the clamp, limb_radius_m as it is, and a normal that points "
                "to the limb's side"
            ) from error

    def check(self, model: RodModel, time: Array, curves: Array, bend_angles: Array) -> str:
        """Refuse a motion that would touch an obstacle with more force than that allows.

        Returns a sentence on those that are touched with what is allowed; empty where none is.

        Args:
            model: rod of the limb.
            time: (K,) of the poses [s].
            curves: (K, P, 2) their centrelines [m].
            bend_angles: (K, M) of them [rad].

        Raises:
            ObstacleError: names instant, place, clearance and force.
        """
        touched = []
        for obstacle in self.items:
            found = self.nearest(obstacle, curves)
            if found.clearance >= 0.0:
                continue
            slack = _slack(model, bend_angles[found.index], found)
            force = -found.clearance / slack if slack > 0.0 and not found.passes else math.inf
            if force > obstacle.allowed_force:
                instant = float(time[found.index])
                raise ObstacleError(instant, found.place, found.clearance, force, obstacle)
            touched.append(f"{obstacle.name} with up to {force:.2f} N")
        if not touched:
            return ""
        return f"the limb touches {', '.join(touched)}; the tip is predicted as if nothing held it"

    def led_past(
        self,
        model: RodModel,
        curves: Array,
        bend_angles: Array,
        off: tuple[Array, Array],
        room: tuple[Array, Array],
    ) -> Array:
        """Return a change (K, M) of a motion's bend angles [rad] that leads it past its obstacles.

        It is zero where every pose has its distance. Else all poses are changed together, smoothly:
        the tip stays as near to its path as it can, and no point of the limb goes nearer to an
        obstacle than it may. Places are taken for linear in the change. So it is small, and sought
        again about what it has led to.

        Args:
            model: rod of the limb.
            curves: (K, P, 2) centrelines of the poses [m].
            bend_angles: (K, M) of them [rad].
            off: (K, 2) of the tip from its path [m], and (K, 2, M) its derivative [m/rad].
            room: (K, M) least and largest change [rad].
        """
        points, moved = _fine(curves), model.kinematics.tangents(bend_angles)
        clamp = ((0, 0), (0, 0), (curves.shape[1] - moved.shape[2], 0), (0, 0))
        moved = _fine(np.pad(moved, clamp))
        found = []
        for obstacle in self.items:
            nearest, (distance, out) = self.nearest(obstacle, curves), obstacle.away(points)
            least = -obstacle.allowed_force * _slack(model, bend_angles[nearest.index], nearest)
            clearance = distance - self.limb_radius
            # No pose is led farther away than the limb begins.
            lacking = least + min(_MARGIN, clearance[0].min()) - clearance
            near = np.nonzero(lacking > -_BESIDE)
            away = np.einsum("rmc,rc->rm", moved[near[0], :, near[1]], out[near])
            found.append((near[0], away, lacking[near]))
        pose, away, wanted = (np.concatenate(column) for column in zip(*found, strict=True))
        if np.all(wanted <= 0.0) and not off[0].any():
            return np.zeros_like(bend_angles)
        own, air = np.diff(bend_angles, axis=0), model.limb.pneumatics
        rate = SLEW_SHARE * air.slew_limit * CONTROL_PERIOD * model.limb.static_gain
        turns = np.minimum(-rate - own, 0.0), np.maximum(rate - own, 0.0)
        return _smallest(pose, away, wanted, off, (room, turns))


def _fine(curves: Array) -> Array:
    """Return points (…, Q, 2) along polylines (…, P, 2)."""
    share = np.arange(_FINE)[:, None] / _FINE
    pieces = curves[..., :-1, None, :] + share * np.diff(curves, axis=-2)[..., None, :]
    within = pieces.reshape(*curves.shape[:-2], -1, 2)
    return np.concatenate([within, curves[..., -1:, :]], axis=-2)


def _smallest(
    pose: Array,
    away: Array,
    wanted: Array,
    off: tuple[Array, Array],
    within: tuple[tuple[Array, Array], tuple[Array, Array]],
) -> Array:
    """Return the change (K, M) of bend angles [rad] that brings points away from obstacles.

    It minimises Σ |off + J δ|² + ν² |δ|² + λ² |D² δ|² + w² e² with away · δ + e ≥ wanted, D² the
    second difference, and an e ≥ 0 of each pose: what cannot be done in one step is done in part.

    Args:
        pose: (R,) of each point.
        away: (R, M) by which a point moves away [m/rad].
        wanted: (R,) by how much it should [m].
        off: see `Obstacles.led_past`.
        within: least and largest change (K, M) and steps of it from pose to pose (K − 1, M) [rad].
    """
    (missed, slopes), (room, turns) = off, within
    count, inputs = missed.shape[0], away.shape[1]
    near = sparse.bsr_array((slopes, np.arange(count), np.arange(count + 1)))
    second = sparse.diags_array([1.0, -2.0, 1.0], offsets=[0, -1, -2], shape=(count + 2, count))
    smooth = _SMOOTH * sparse.kron(second, sparse.eye_array(inputs))
    pull = near.T @ near + smooth.T @ smooth + _NEARNESS**2 * sparse.eye_array(count * inputs)
    square = sparse.block_diag([pull, _PART**2 * sparse.eye_array(count)], format="csc")
    places = inputs * pose[:, None] + np.arange(inputs)
    columns = np.column_stack([places, count * inputs + pose])
    factors = np.column_stack([away, np.ones(len(pose))])
    ends = np.arange(len(pose) + 1) * (inputs + 1)
    rows = sparse.csr_array((factors.ravel(), columns.ravel(), ends), (len(pose), square.shape[0]))
    first = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count))
    steps = sparse.kron(first, sparse.eye_array(inputs))
    apart = sparse.csr_array((steps.shape[0], count))
    solver, zeros = piqp.SparseSolver(), np.zeros(count)
    solver.setup(
        sparse.csc_matrix(square),
        np.append(near.T @ missed.ravel(), zeros),
        None,
        None,
        sparse.csc_matrix(sparse.vstack([rows, sparse.hstack([steps, apart])])),
        np.append(wanted, turns[0]),
        np.append(np.full(len(wanted), np.inf), turns[1]),
        np.append(np.maximum(room[0], -_STEP), zeros),
        np.append(np.minimum(room[1], _STEP), np.full(count, np.inf)),
    )
    if solver.solve() != piqp.PIQP_SOLVED:
        return np.zeros((count, inputs))  # the motion is refused
    change: Array = np.asarray(solver.result.x)[: count * inputs].reshape(count, inputs)
    return change


def _slack(model: RodModel, bend: Array, found: Nearest) -> float:
    """Return how far a pose with bend angles (M,) gives way to a force out of an obstacle [m/N]."""
    limp = compliance(model, bend, [found.place])
    return float(found.out @ limp.place[0] @ found.out)


def _obstacle(item: Any) -> Obstacle:
    """Return one obstacle of a file.

    Raises:
        ValueError: it is neither a circle nor a half-plane.
    """
    keys = set(item) if isinstance(item, Mapping) else set()
    allowed = _number(item.get("allowed_force_n", 0.0), "allowed_force_n") if keys else 0.0
    if {"circle_m", "radius_m"} <= keys <= _CIRCLE:
        radius = _number(item["radius_m"], "radius_m")
        centre = _finite(item["circle_m"], (2,), "circle_m")
        return Obstacle(centre, radius, allowed, f"the circle at {place_of(centre)}")
    if {"half_plane_m", "normal"} <= keys <= _HALF_PLANE:
        edge, normal = (_finite(item[key], (2,), key) for key in ("half_plane_m", "normal"))
        size = float(np.linalg.norm(normal))
        if size == 0.0:
            raise ValueError("the normal of a half-plane has a direction")
        centre = edge - _LARGE / size * normal
        return Obstacle(centre, _LARGE, allowed, f"the edge at {place_of(edge)}")
    raise ValueError(
        f"an obstacle has {', '.join(sorted(_CIRCLE))}, or {', '.join(sorted(_HALF_PLANE))}; got "
        f"{item}"
    )


def _number(value: Any, name: str) -> float:
    number = float(_finite(value, (), name))
    if number < 0.0:
        raise ValueError(f"{name} must be 0 or more, got {value}")
    return number


def _finite(value: Any, shape: tuple[int, ...], name: str) -> Array:
    try:
        numbers = np.array(value, dtype=float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        kind = "two numbers x, y" if shape else "a number"
        raise ValueError(f"{name} must be {kind}, got {value}")
    return numbers
