"""How a limb at rest gives way to forces along it and to pressures, about a pose.

A force f at a place s loads each joint i of the rod before it with the moment (p(s) − p_i) × f. The
joint turns by this over its stiffness, and all that is beyond it turns with it: an Euler-Bernoulli
cantilever about its bent shape, whose edges keep their length. Pressures are couples that follow
the limb. That the limb's weight pulls elsewhere once it has given way is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from der_planner.arrays import Array, interpolate
from der_planner.model.bending import end_edges
from der_planner.model.rod import RodModel


@dataclass(frozen=True)
class Compliance:
    """First-order changes of a limb at rest, by a force (2,) at each of P places and by pressures.

    Attributes:
        bend: (P, M, 2) of the bend angles by force [rad/N].
        tip: (P, 2, 2) of the tip by force [m/N].
        place: (P, 2, 2) of the place itself by force [m/N].
        bend_by_pressure: (M, M) by effective pressure [rad/Pa].
    """

    bend: Array
    tip: Array
    place: Array
    bend_by_pressure: Array


def compliance(model: RodModel, bend_angles: ArrayLike, places: ArrayLike) -> Compliance:
    """Return how a limb gives way about an evenly bent pose.

    Args:
        model: of the limb.
        bend_angles: (M,) of the pose [rad].
        places: (P,) where forces may act, along the limb from its clamp [m].
    """
    rod, even = model.rod, model.kinematics
    angles, at = np.asarray(bend_angles, dtype=float), np.asarray(places, dtype=float)
    nodes = even.nodes(angles)
    joints = nodes[:-1]
    along = even.base + np.append(0.0, np.cumsum(even.rest_lengths))
    points = interpolate(at, along, nodes)
    # What is at a place turns about the joints before it.
    arms = np.where((at[:, None] > along[:-1])[..., None], points[:, None] - joints, 0.0)
    sweep, tip_sweep = _turned(arms), _turned(nodes[-1] - joints)
    slack = 1.0 / joint_stiffness(model, angles)
    turns = slack[:, None] * sweep
    bends = np.diff(even.turning, axis=0, prepend=0.0) > 0.0
    pressed = slack[:, None] * bends * model.balance.moment_gain
    # A bend angle is the heading of the edge at a segment's end, less that before the segment.
    ends = np.array(end_edges(rod))[:, None]
    before = (np.arange(len(joints)) <= ends).astype(float)
    share = np.diff(before, axis=0, prepend=0.0)
    return Compliance(
        np.einsum("mj,pjf->pmf", share, turns),
        np.einsum("ja,pjf->paf", tip_sweep, turns),
        np.einsum("pja,pjf->paf", sweep, turns),
        share @ pressed,
    )


def joint_stiffness(model: RodModel, bend_angles: Array) -> Array:
    """Return ∂moment/∂turn (N−1,) [N·m/rad] of the joints of an evenly bent limb.

    A joint's moment is (b + c e²) e dκ/dturn with κ = 2 tan(turn / 2) and e = κ − κ at rest.
    """
    mesh, even = model.rod.mesh, model.kinematics
    turn = np.diff(even.turning, axis=0, prepend=0.0) @ bend_angles
    kappa = 2.0 * np.tan(turn / 2)
    growth, excess = 1.0 + kappa**2 / 4, kappa - mesh.rest_kappa[:-1, 0]
    bend, cubic = mesh.bend[:-1], mesh.cubic[:-1]
    stiffness: Array = (bend + 3.0 * cubic * excess**2) * growth**2
    stiffness += (bend + cubic * excess**2) * excess * growth * kappa / 2
    return stiffness


def _turned(arms: Array) -> Array:
    """Return arms (…, 2) turned by a right angle to the left: how their ends move."""
    return np.stack([-arms[..., 1], arms[..., 0]], axis=-1)
