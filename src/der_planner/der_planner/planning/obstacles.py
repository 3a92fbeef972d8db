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
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import NonlinearConstraint, minimize

from der_planner.arrays import Array
from der_planner.files import read_yaml
from der_planner.model import RodModel
from der_planner.model.compliance import compliance
from der_planner.planning.loads import PlanningError, place_of

_CIRCLE = {"circle_m", "radius_m", "allowed_force_n"}
_HALF_PLANE = {"half_plane_m", "normal", "allowed_force_n"}
_FINE = 4
"""Points a piece of the centreline between two nodes."""
_LARGE = 1e4
"""Radius of a circle whose edge is straight beside a limb [m]."""
_MARGIN = 1.5e-3
"""Distance that poses which are led past keep beside what is allowed [m]."""
_SMOOTHED = 4.0
"""Standard deviation, in poses, by which the way past is smoothed: it would begin with a kink."""
_NEARNESS = 1e-3
"""Tip error that a unit change of a bend angle is worth there [m/rad]."""
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

    def __str__(self) -> str:
        """Return its name."""
        return self.name


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
            f"{self.obstacle}, {self.place * 100:.1f} cm from its clamp, {with_force}: shrink or "
            "move the motion"
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
        share = np.arange(_FINE) / _FINE
        pieces = curves[:, :-1, None] + share[:, None] * np.diff(curves, axis=1)[:, :, None]
        points = np.concatenate([pieces.reshape(len(curves), -1, 2), curves[:, -1:]], axis=1)
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
                    f"{each} may be touched with {each.allowed_force:g} N, and the tip presses "
                    f"with some {force:.2g} N at most: give N"
                )
            if abs(each.away(np.zeros(2))[0]) > _OTHER_UNIT * length:
                raise PlanningError(
                    f"{each} in the file of obstacles is far too large for a limb of {length:.3g} "
                    "m: give all lengths in metres"
                )
        try:
            self.check(model, np.zeros(1), curve[None], bend[None])
        except ObstacleError as error:
            raise PlanningError(
                f"the resting limb is {-error.clearance * 1000:.1f} mm inside {error.obstacle}, "
                f"{error.place * 100:.1f} cm from its clamp: give its place in metres from the "
                "clamp, limb_radius_m as it is, and a normal that points to the limb's side"
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
            touched.append(f"{obstacle} with up to {force:.2f} N")
        if not touched:
            return ""
        return f"the limb touches {', '.join(touched)}; the tip is predicted as if nothing held it"

    def led_past(self, model: RodModel, curves: Array, bend_angles: Array) -> Array:
        """Return by how much the tip is led aside (K, 2) [m] to keep off what is in the way.

        A pose that would touch with more force than is allowed is moved: its bend angles minimise
        the tip's distance, with every obstacle as far away as it must be.

        Args:
            model: rod of the limb.
            curves: (K, P, 2) centrelines of the poses [m].
            bend_angles: (K, M) of them [rad].
        """
        moved, change = np.zeros((len(curves), 2)), np.zeros(bend_angles.shape[1])
        for k, (curve, bend) in enumerate(zip(curves, bend_angles, strict=True)):
            near = [self.nearest(each, curve[None]) for each in self.items]
            if all(found.clearance >= 0.0 for found in near):
                change = np.zeros_like(change)
                continue
            least = np.array(
                [
                    _MARGIN - each.allowed_force * _slack(model, bend, found)
                    for each, found in zip(self.items, near, strict=True)
                ]
            )
            change = self._aside(model, curve, bend, least, change)
            moved[k] = model.kinematics.tip(bend + change) - model.kinematics.tip(bend)
        smooth: Array = gaussian_filter1d(moved, _SMOOTHED, axis=0, mode="nearest")
        return smooth

    def _aside(
        self, model: RodModel, curve: Array, bend: Array, least: Array, guess: Array
    ) -> Array:
        """Return the change (M,) of a pose's bend angles [rad] that leads it past.

        Args:
            model: rod of the limb.
            curve: (P, 2) centreline of the pose [m].
            bend: (M,) of it [rad].
            least: of the clearances of the obstacles [m].
            guess: the search begins there.
        """
        even = model.kinematics
        start, tip = even.curve(bend), even.tip(bend)

        def clearances(change: Array) -> Array:
            moved = curve + even.curve(bend + change) - start
            return np.array([self.nearest(each, moved[None]).clearance for each in self.items])

        def cost(change: Array) -> float:
            left = even.tip(bend + change) - tip
            return 1e4 * float(left @ left + _NEARNESS**2 * change @ change)

        # In centimetres, as the solver's tolerances mean it.
        keep_off = NonlinearConstraint(lambda c: 100 * clearances(c), 100 * least, np.inf)
        found = minimize(cost, guess, method="SLSQP", constraints=keep_off)
        return np.asarray(found.x, dtype=float)


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
