"""Where a vented limb rests under its loads, and whether it stays there."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.limb import Limb
from der_planner.model import ArcModel, RodModel
from der_planner.model.bending import bend_angles
from der_planner.planning.errors import BucklingError
from der_planner.planning.inverse import solve
from der_planner.rod import ConvergenceError, Rod, RodState

Array = NDArray[np.float64]

_STRAIGHT = 1e-3
"""A limb that rests within this bend [rad] of straight starts there."""
NEAR = 1.1
"""A standing limb that would buckle under less than this multiple of its load is near that [-]."""
_APART = 1e-3
"""Two resting shapes that are this far apart are two [m]."""


@dataclass(frozen=True)
class Rest:
    """The pose in which a vented limb rests, as bend angles of arcs with the rod's tip.

    Attributes:
        bend_angles: (M,) under the loads [rad].
        sag: (M,) what the loads alone add to the bend without loads [rad].
        offset: (2,) of the rod's tip from that of these arcs [m]: stretch, and what arcs cannot do.
    """

    bend_angles: Array
    sag: Array
    offset: Array


def rest_of(limb: Limb) -> Rest:
    """Return where a vented limb rests.

    Without gravity that is its rest curvature. With gravity it is the rod's equilibrium, and the
    arcs that have its tip.

    Raises:
        BucklingError: the limb does not stay where it rests.
    """
    own = np.array([s.rest_curvature * s.length for s in limb.segments])
    if np.abs(own).max() < _STRAIGHT:
        own = np.zeros_like(own)
    if not any(limb.gravity):
        return Rest(own, np.zeros_like(own), np.zeros(2))
    model = RodModel(limb)
    state = stable_rest(model)
    near = bend_angles(model.rod, state.q[None])
    arcs = ArcModel(limb)
    angles = solve(arcs, state.q[None, -3:-1], near)[0][0]
    if np.abs(angles).max() < _STRAIGHT:
        angles = np.zeros_like(angles)
    return Rest(angles, angles - own, state.q[-3:-1] - arcs.tip(angles))


def stable_rest(model: RodModel) -> RodState:
    """Return the rod's resting state without pressure.

    Raises:
        BucklingError: the rod does not stay there, or it may as well rest in its mirror image.
    """
    rod, vented = model.rod, np.zeros(model.limb.segment_count)
    try:
        state = model.rest
    except ConvergenceError as error:
        raise BucklingError(_said(model.limb, "finds no rest under its loads")) from error
    if rod.smallest_stiffness(state, vented) <= 0:
        raise BucklingError(_said(model.limb, "does not stay upright under its loads"))
    if model.limb.gravity[0] < 0 and _has_a_mirror_image(rod, state):
        raise BucklingError(_said(model.limb, "may fall to either side under its loads"))
    return state


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


def _said(limb: Limb, what: str) -> str:
    share = critical_share(limb)
    if share >= 1:
        return f"the limb '{limb.name}' {what}: mount it otherwise, or let it carry less"
    mass = float(Rod.from_limb(limb).mesh.node_mass.sum())
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
    low, high = 0.0, 1.0
    for _ in range(12):
        share = 0.5 * (low + high)
        gravity = (share * limb.gravity[0], 0.0, 0.0)
        rod = Rod.from_limb(dataclasses.replace(along, gravity=gravity))
        vented = np.zeros(limb.segment_count)
        if rod.smallest_stiffness(rod.equilibrium(vented), vented) > 0:
            low = share
        else:
            high = share
    return high
