"""A motion as a row of poses in which pressures hold a loaded rod, and the pressures that move it.

Under gravity the shape at given bend angles is not even, and a balance of forces along even shapes
is wrong by far. So the tip's path r̄(t) is followed through resting poses q̄(t) of the rod itself,
every 0.1 s, with quintic splines between them. On these,

    B(q̄) Λ w = M q̄̈ + D q̄̇ − F_int − F_ext

is solved for w by the paper's pseudo-inverse, or projected on the tangent ∂q̄/∂w of the poses
(virtual work); where the motion is slow both are the pressures that hold the poses.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline

from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.model.bending import bend_angles
from der_planner.model.material import Material
from der_planner.model.poses import PoseFinder, Poses
from der_planner.planning.errors import (
    BucklingError,
    OverloadError,
    PlanningError,
    UnreachableError,
)
from der_planner.planning.loads.overload import check_load, check_stays
from der_planner.planning.loads.rest import stable_rest
from der_planner.planning.motions import Reference
from der_planner.planning.ways import Start, resting_spline, sample_spline
from der_planner.rod import ConvergenceError, Rod, RodState

Array = NDArray[np.float64]

REFERENCE_PRIOR = 2e-3
"""Pull of the rod's bend angles toward the arcs' [m/rad]. The rod's polyline reaches a little less
far than the arcs: the pull keeps its angles smooth where the reference touches its fold, and costs
0.03 mm."""
_STEP = 0.1
"""Between two poses [s]."""
_TOLERANCE = 0.01
"""Share of the length by which a pose may miss: near its fold a loaded limb reaches less far than
the arcs of a named motion."""
_SPARSE = 5
"""Of so many poses one is enough to find what the limb could carry."""


@dataclass(frozen=True)
class PosedMotion:
    """A motion of a rod along its own resting poses.

    Attributes:
        rod: that moves.
        time: (K,) of the poses [s].
        poses: at these instants.
        bend: their bend angles (M,) [rad] over time.
        shape: their free coordinates (F,) over time.
    """

    rod: Rod
    time: Array
    poses: Poses
    bend: BSpline
    shape: BSpline

    def sample(self, time: Array) -> tuple[Array, Array, Array]:
        """Return q, its rate and acceleration (…, 4N-1) at instants [s]."""
        straight = self.rod.straight_state().q
        result = []
        for order, part in enumerate(sample_spline(self.shape, time)):
            full = np.zeros((*part.shape[:-1], len(straight)))
            if order == 0:
                full[...] = straight
            full[..., self.rod.free] = part
            result.append(full)
        return result[0], result[1], result[2]

    def state(self, time: float) -> RodState:
        """Return the rod on its way at an instant [s]."""
        q, v, _ = self.sample(np.array(time))
        near = int(np.abs(self.time - time).argmin())
        return self.rod.state(q, v, like=self.poses.states[near])

    @cached_property
    def _forces(self) -> tuple[Array, Array]:
        """M q̄̈ + D q̄̇ − F_int − F_ext (K, F) [N] and B Λ (K, F, M) [N/Pa] at the poses.

        A pose rests under its own pressures: −F_int − F_ext is B Λ times these.
        """
        rod, free = self.rod, self.rod.free
        q, v, a = self.sample(self.time)
        forces, inputs = [], []
        for k, state in enumerate(self.poses.states):
            inputs.append(rod.input_matrix(state)[free])
            moved = rod.mass_diagonal * a[k] + rod.damping_diagonal * v[k]
            moved += _viscous_force(rod, q[k], v[k])
            forces.append(inputs[-1] @ self.poses.pressures[k] + moved[free])
        return np.array(forces), np.array(inputs)

    def projected(self, time: Array) -> Array:
        """Return effective pressures (…, M) [Pa] by virtual work along the poses."""
        forces, inputs = self._forces
        tangents = self.poses.tangents
        work = np.einsum("kfm,kf->km", tangents, forces)
        by_pressure = np.einsum("kfm,kfn->kmn", tangents, inputs)
        return interpolate_smoothly(time, self.time, np.linalg.solve(by_pressure, work[..., None]))

    def paper(self, time: Array) -> tuple[Array, Array]:
        """Return effective pressures (K, M) [Pa] by (B Λ)†, and (B Λ)† (K, M, F) [Pa/N]."""
        forces, inputs = self._forces
        inverse = np.asarray(np.linalg.pinv(inputs), dtype=np.float64)
        pressures = interpolate_smoothly(time, self.time, inverse @ forces[..., None])
        nearest = np.rint(np.interp(time, self.time, np.arange(len(self.time)))).astype(int)
        return pressures, inverse[nearest]


def _viscous_force(rod: Rod, q: Array, v: Array) -> Array:
    """Return what Kelvin-Voigt damping of bending in the xy plane takes (4N-1,) [N]."""
    mesh = rod.mesh
    if not mesh.viscous.any():
        return np.zeros_like(q)
    dx, dy = np.diff(q[0::4]), np.diff(q[1::4])
    edges = np.arange(len(dx))
    # ∂(heading of an edge)/∂q, and by it that of the curvature κ = 2 tan(turn / 2) of each node.
    heading = np.zeros((len(dx), len(q)))
    for end, sign in ((0, 1.0), (1, -1.0)):
        heading[edges, 4 * (edges + end)] = sign * dy / (dx**2 + dy**2)
        heading[edges, 4 * (edges + end) + 1] = -sign * dx / (dx**2 + dy**2)
    turn = np.diff(np.unwrap(np.arctan2(dy, dx)), prepend=0.0)
    growth = 1.0 + np.tan(0.5 * turn) ** 2
    curving = growth[:, None] * np.diff(heading, axis=0, prepend=0.0)
    force: Array = curving.T @ (mesh.viscous[:-1] * (curving @ v))
    return force


def interpolate_smoothly(time: Array, instants: Array, columns: Array) -> Array:
    """Return columns (K, M, 1) at instants (K,) as (…, M) at others, by a spline."""
    return sample_spline(resting_spline(instants, columns[..., 0]), time)[0]


def posed_motion(model: RodModel, reference: Reference, nodes: int) -> PosedMotion:
    """Return the poses along a reference.

    Raises:
        UnreachableError: a point is out of the rod's reach.
        OverloadError: a pose takes more pressure than the limb may have.
        BucklingError: the rod does not stay at a pose.
    """
    limb = model.limb
    count = max(8, int(np.ceil(reference.duration / _STEP)) + 1)
    time = np.linspace(0.0, reference.duration, count)
    tip = interpolate_smoothly(time, reference.time, reference.tip[..., None])
    # The rod's own bend angles where it rests: there the poses begin and end without pressure.
    home = bend_angles(model.rod, stable_rest(model).q[None])[0]
    guess = reference.sample(time)[0] + (home - reference.rest)
    poses = _poses(model, time, tip, guess)
    pressure = _needed(limb, time, poses)
    worst = int(np.abs(pressure).max(axis=1).argmax())
    some = np.unique(np.append(np.arange(0, count, _SPARSE), [0, worst, count - 1]))

    def needed(lighter: Limb) -> Array:
        fewer = _poses(RodModel(lighter, nodes), time[some], tip[some], guess[some])
        left = _unreached(lighter, time[some], tip[some], fewer)
        if left is not None:
            raise left
        return _needed(lighter, time[some], fewer)

    unreached = _unreached(limb, time, tip, poses)
    try:
        if unreached is None or limb.masses:
            check_load(limb, time, tip, pressure, needed)
    except OverloadError as error:
        # What keeps the limb from a point is its load only if it would be there with less of it.
        if unreached is None or error.possible_mass is not None:
            raise
    if unreached is not None:
        raise unreached
    q = np.array([state.q for state in poses.states])[:, model.rod.free]
    bend, shape = (_through(time, values, reference.start) for values in (poses.bend_angles, q))
    return PosedMotion(model.rod, time, poses, bend, shape)


def _unreached(limb: Limb, time: Array, tip: Array, poses: Poses) -> UnreachableError | None:
    """Return the error of poses that miss their points (K, 2) [m]; None where none does."""
    missed = poses.misses > _TOLERANCE * limb.length
    if not missed.any() or limb.segment_count == 1:
        return None
    k = int(np.argmax(missed))
    point = float(tip[k, 0]), float(tip[k, 1])
    carried = sum(item.mass for item in limb.masses)
    return UnreachableError(float(time[k]), point, float(poses.misses[k]), float("nan"), carried)


def _through(time: Array, values: Array, start: Start | None) -> BSpline:
    """Return the spline through (K, n) values; one that another motion precedes begins moving."""
    if start is None:
        return resting_spline(time, values)
    passing = make_interp_spline(time, values, k=5)
    begin = dataclasses.replace(start, rate=passing(0.0, 1), acceleration=passing(0.0, 2))
    return resting_spline(time, values, begin)


def _poses(model: RodModel, time: Array, tip: Array, guess: Array) -> Poses:
    holder = PoseFinder(model, REFERENCE_PRIOR)
    try:
        poses = holder.along(stable_rest(model), tip, guess)
    except ConvergenceError as error:
        raise BucklingError(
            f"no pose of the limb leads on to its tip at ({tip[error.step, 0]:.4f}, "
            f"{tip[error.step, 1]:.4f}) m at t = {time[error.step]:.2f} s: it would buckle or snap "
            "through under its load. Shrink or move the motion, or mount the limb otherwise"
        ) from error
    check_stays(poses.smallest_stiffness, time, tip, "limb")
    return poses


def _needed(limb: Limb, time: Array, poses: Poses) -> Array:
    """Return the differential pressures (K, M) [Pa] that hold poses."""
    try:
        return Material(limb).differential_pressure(time, poses.pressures, poses.bend_angles)
    except ValueError as error:
        raise PlanningError(str(error)) from error
