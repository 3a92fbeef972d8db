"""Inverse kinematics: bend angles for tip positions, by damped least squares on given kinematics.

A limb of two segments reaches most points in two ways, on either side of the fold where the
Jacobian loses its rank (the straight limb lies on that fold). A branch is named by how the last
segment bends compared with the fold: ``counter_clockwise`` or ``clockwise``. All points of a path
are solved in the same matrix operations, each from its own first guess, which decides the branch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.model.bending import Kinematics
from der_planner.planning.errors import PlanningError

Array = NDArray[np.float64]

PRIOR_WEIGHT = 1e-5
"""Pull toward the first guess [m/rad]: decides what the tip leaves open (straight limb, M > 2)."""
BRANCHES = ("counter_clockwise", "clockwise")
"""Names of the two ways in which two segments reach a point."""
_ITERATIONS = 60
_SMALLEST_STEP = 1e-11
"""Change of the bend angles that ends the iteration [rad]."""


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
