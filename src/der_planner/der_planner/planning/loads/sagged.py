"""The tip of a limb that sags out of its plane of motion, at the bend angles of a motion.

A level limb that is free to sag under gravity along −z comes less far out than arcs of its length
say. Its reference is therefore the tip of the rod in space, held by pressures so that its segments
bend by the motion's angles, as seen along z.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.model.bending import bend_angles
from der_planner.model.poses import PoseFinder
from der_planner.model.series import interpolate
from der_planner.planning.errors import BucklingError
from der_planner.planning.loads.rest import stable_rest
from der_planner.rod import ConvergenceError

Array = NDArray[np.float64]

_STEP = 0.1
"""Between two poses [s]."""


def sagged_tips(limb: Limb, time: Array, angles: Array, rest: Array) -> Array:
    """Return the tips (K, 2) [m] of the rod in space that bends by angles (K, M) [rad].

    Args:
        limb: whose gravity leaves the plane.
        time: (K,) for messages [s].
        angles: of the motion; where they are ``rest`` the rod rests.
        rest: (M,) bend angles of the arcs at rest [rad].

    Raises:
        BucklingError: the rod does not stay on the way.
    """
    model = RodModel(limb)
    state = stable_rest(model)
    home = bend_angles(model.rod, state.q[None])[0]
    count = max(8, math.ceil((time[-1] - time[0]) / _STEP) + 1)
    instants = np.linspace(time[0], time[-1], count)
    wanted = interpolate(instants, time, angles) + (home - rest)
    holder = PoseFinder(model, prior=1.0, tip_weight=0.0)
    try:
        poses = holder.along(state, np.tile(state.q[-3:-1], (count, 1)), wanted)
    except ConvergenceError as error:
        raise BucklingError(
            f"the limb cannot be held at t = {instants[error.step]:.2f} s: under its load it would "
            "snap through. Shrink the motion, or mount the limb otherwise"
        ) from error
    tips = np.array([state.q[-3:-1] for state in poses.states])
    smooth: Array = make_interp_spline(instants, tips, k=5)(time)
    return smooth
