"""A limb under its loads: whether it stays where it rests, how it sags, what pressures can hold.

Errors stand beside what raises them: of loads here, of reach in `workspace`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.limb import PAYLOAD, Limb
from der_planner.model import AnyModel, RodModel
from der_planner.model.rod import PoseFinder, Poses
from der_planner.rod import ConvergenceError, Rod, RodState

NEAR = 1.1
"""A standing limb that would buckle under less than this multiple of its load is near that [-]."""
_APART = 1e-3
"""Two resting shapes that are this far apart are two [m]."""
_HALVINGS = 8
"""Steps of the bisection for the mass that could be carried."""


def place_of(point: Array) -> str:
    """Return a point (2,) [m] as messages say it."""
    return f"({point[0]:.4f}, {point[1]:.4f}) m"


class PlanningError(ValueError):
    """A motion, method or limit does not allow a plan; the message says what to change."""


class BucklingError(PlanningError):
    """The limb buckles, snaps through or has more than one rest under its loads.

    Args:
        said: for people.
        point: (2,) of the tip where it does so on its way [m]; None: it does so at rest.
    """

    def __init__(self, said: str, point: Array | None = None) -> None:
        super().__init__(said)
        self.point = point


@dataclass(eq=False)
class OverloadError(PlanningError):
    """Holding the limb along a motion takes more pressure than it may have.

    Attributes:
        time: when most is needed [s].
        point: (2,) of the tip then, in `limb_base` [m].
        segment: which needs most.
        required_pressure: |differential pressure| that it needs there at rest [Pa].
        pressure_limit: largest that is allowed [Pa].
        carried: what the limb carries [kg].
        possible_mass: most that the limb could carry along this motion [kg]; None: it carries
            nothing, or cannot be held without it either.
    """

    time: float
    point: Array
    segment: int
    required_pressure: float
    pressure_limit: float
    carried: float
    possible_mass: float | None

    def __str__(self) -> str:
        """Return a sentence for people, with the remedy."""
        remedy = "Shrink or move the motion, or mount the limb otherwise"
        carried = f"{self.carried * 1000:.1f} g"
        if self.possible_mass is not None:
            remedy = (
                f"It carries {carried}: {self.possible_mass * 1000:.1f} g are possible along this "
                "motion, or more along a smaller one"
            )
        elif self.carried:
            remedy = f"Even without the {carried} that it carries it is too much. {remedy}"
        return (
            f"segment {self.segment} would need {self.required_pressure / 1000:.1f} kPa to hold "
            f"the limb at t = {self.time:.2f} s, where the tip is to be at {place_of(self.point)}: "
            f"{self.pressure_limit / 1000:.1f} kPa are allowed. {remedy}"
        )


def stable_rest(model: RodModel) -> RodState:
    """Return the rod's resting state without pressure.

    Raises:
        BucklingError: the rod does not stay there, or it may as well rest in its mirror image.
    """
    rod, vented = model.rod, np.zeros(model.limb.segment_count)
    try:
        state = model.rest
    except ConvergenceError as error:
        raise BucklingError(_said(model, "finds no rest under its loads")) from error
    if rod.smallest_stiffness(state, vented) <= 0:
        raise BucklingError(_said(model, "does not stay upright under its loads"))
    if model.limb.gravity[0] < 0 and _has_a_mirror_image(rod, state):
        raise BucklingError(_said(model, "may fall to either side under its loads"))
    return state


def held_poses(finder: PoseFinder, start: RodState, time: Array, tip: Array, guess: Array) -> Poses:
    """Return poses for tips (K, 2) [m] near bend angles (K, M) [rad] at times (K,) [s].

    Raises:
        BucklingError: the rod would buckle or snap through on the way.
    """
    try:
        return finder.along(start, tip, guess)
    except ConvergenceError as error:
        point = tip[error.step]
        raise BucklingError(
            f"no pose of the limb leads on to its tip at {place_of(point)} at "
            f"t = {time[error.step]:.2f} s: it would buckle or snap through under its load. Shrink "
            "or move the motion, or mount the limb otherwise",
            point,
        ) from error


def _has_a_mirror_image(rod: Rod, state: RodState) -> bool:
    mirrored = state.q.copy()
    for axis in (1, 2):
        mirrored[axis::4] *= -1
    try:
        other = rod.equilibrium(np.zeros(rod.segment_count), start=rod.state(mirrored, like=state))
    except ConvergenceError:
        return False
    apart = np.abs(other.positions - state.positions).max() > _APART
    return bool(apart) and rod.smallest_stiffness(other, np.zeros(rod.segment_count)) > 0


def _said(model: RodModel, what: str) -> str:
    limb, share = model.limb, critical_share(model.limb)
    if share >= 1:
        return f"the limb '{limb.name}' {what}: mount it otherwise, or let it carry less"
    mass = float(model.rod.mesh.node_mass.sum())
    return (
        f"the limb '{limb.name}' {what}: straight it buckles under {share * mass:.3f} kg spread as "
        f"its {mass:.3f} kg are ({share:.2f} of them). A bending stiffness {1 / share:.2f} times "
        "as large, less mass, a shorter limb or another mounting keeps it upright"
    )


def nearly_buckling(limb: Limb) -> str:
    """Return a sentence where a standing limb is near the load at which it buckles; else empty."""
    x, y, z = limb.gravity
    if x >= 0:
        return ""
    share = critical_share(dataclasses.replace(limb, gravity=(NEAR * x, y, z)))
    if share >= 1:
        return ""
    return (
        f"the limb stands under {100 / (NEAR * share):.0f} % of the load under which it would "
        "buckle if it were straight: there a few per cent of stiffness or mass, and friction, move "
        "its tip by centimetres, which neither rod nor arcs predict. Hang it, or make it stiffer "
        "or lighter"
    )


def critical_share(limb: Limb) -> float:
    """Return the share of its gravity under which a straight limb buckles, by bisection; ≤ 1."""
    straight = tuple(dataclasses.replace(s, rest_curvature=0.0) for s in limb.segments)
    along = dataclasses.replace(limb, segments=straight, pcc_segments=())
    vented = np.zeros(limb.segment_count)

    def stays(share: float) -> bool:
        gravity = (share * limb.gravity[0], 0.0, 0.0)
        rod = Rod.from_limb(dataclasses.replace(along, gravity=gravity))
        return rod.smallest_stiffness(rod.equilibrium(vented), vented) > 0

    return _edge(stays, 12)[1]


def _edge(holds: Callable[[float], bool], halvings: int) -> tuple[float, float]:
    """Return two shares, up to 1, of which the lower one holds and the upper one may not."""
    low, high = 0.0, 1.0
    for _ in range(halvings):
        share = 0.5 * (low + high)
        low, high = (share, high) if holds(share) else (low, share)
    return low, high


def check_load(
    model: AnyModel, time: Array, tip: Array, pressure: Array, needed: Callable[[AnyModel], Array]
) -> None:
    """Refuse a motion along which resting takes more pressure than the limb may have.

    Args:
        model: of the limb.
        time: (K,) [s].
        tip: (K, 2) of the motion [m].
        pressure: (K, M) differential pressures that hold the limb at rest at these instants [Pa].
        needed: returns the same of a limb that carries less.

    Raises:
        OverloadError: with what is needed, when and where, and what could be carried.
    """
    limb, limit = model.limb, model.limb.pneumatics.pressure_limit
    if np.abs(pressure).max() <= limit:
        return
    named = [mass for mass in limb.masses if mass.name == PAYLOAD] or limb.masses
    carried = sum(mass.mass for mass in named)

    def holds(share: float) -> bool:
        lighter = tuple(
            dataclasses.replace(mass, mass=share * mass.mass) if mass in named else mass
            for mass in limb.masses
        )
        try:
            less = needed(model.another(dataclasses.replace(limb, masses=lighter)))
        except (ConvergenceError, ValueError):
            return False
        return bool(np.abs(less).max() <= limit)

    possible = _edge(holds, _HALVINGS)[0] * carried if carried and holds(0.0) else None
    k, segment = np.unravel_index(int(np.abs(pressure).argmax()), pressure.shape)
    most = float(np.abs(pressure[k, segment]))
    raise OverloadError(float(time[k]), tip[k], int(segment), most, limit, carried, possible)


def check_stays(stiffness: Array, time: Array, tip: Array, what: str) -> None:
    """Refuse a motion with a pose from which the limb would snap through.

    Args:
        stiffness: (K,) smallest eigenvalue of the static stiffness at each pose.
        time: (K,) [s].
        tip: (K, 2) of the poses [m].
        what: "limb" or "arcs", for the message.

    Raises:
        BucklingError: names the first such pose.
    """
    falls = stiffness <= 0
    if falls.any():
        k = int(np.argmax(falls))
        raise BucklingError(
            f"the {what} would snap through under the load at t = {time[k]:.2f} s, tip at "
            f"{place_of(tip[k])}. Shrink or move the motion, or mount the limb otherwise",
            tip[k],
        )
