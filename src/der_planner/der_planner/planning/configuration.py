"""The configurations of a model along a reference, and the pressures that move it through them.

Arcs take q̄(t) itself. A rod without gravity bends evenly, by angles that bring its own tip to r̄(t).

Under gravity the shape of a rod at given bend angles is not even, and a balance of forces along
even shapes is wrong by far. So r̄(t) is followed through resting poses q̄(t) of the rod itself, every
0.1 s, with quintic splines between them. On these,

    B(q̄) Λ w = M q̄̈ + D q̄̇ − F_int − F_ext

is solved for w by the paper's pseudo-inverse, or projected on the tangent ∂q̄/∂w of the poses
(virtual work); where the motion is slow both are the pressures at which the poses rest.
"""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod
from dataclasses import replace

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from der_planner.arrays import Array, interpolate
from der_planner.model import (
    CONTROL_PERIOD,
    ArcModel,
    Initial,
    Model,
    Response,
    RodModel,
    State,
    simulate,
)
from der_planner.model.bending import TipNearPoses, TipOfBend, coordinates, inverse_kinematics
from der_planner.model.rod import PoseFinder, Poses
from der_planner.model.simulation import Bend
from der_planner.planning.loads import (
    BucklingError,
    PlanningError,
    check_load,
    check_stays,
    held_poses,
    stable_rest,
)
from der_planner.planning.motions import Reference
from der_planner.planning.timing import Start, resting_spline, sample_spline
from der_planner.planning.workspace import (
    NEAREST_TOLERANCE,
    POSE_PERIOD,
    TOLERANCE,
    UnreachableError,
    Workspace,
)
from der_planner.rod import Rod, RodState

METHODS = {"der": ("paper", "projected", "optimal"), "pcc": ("paper", "projected", "optimal")}
"""The methods of each model. Arcs have one unknown a pressure: their two balances are the same."""
POSITION_GAIN = 20.0
"""K_p of the method ``paper`` [1/s²]."""
VELOCITY_GAIN = 8.0
"""K_d of the method ``paper`` [1/s]: with K_p a damped return at 0.7 Hz."""
REFERENCE_PRIOR = 2e-3
"""Pull of the rod's bend angles toward the arcs' [m/rad]. The rod's polyline reaches a little less
far than the arcs: the pull keeps its angles smooth where the reference touches its fold, and costs
0.03 mm."""
_INSIDE = 1e-9
"""Bend angles this far [rad] within their limits are within them, whatever is rounded."""
_FALLEN = 1.0
"""Arcs that rest this far from the rod have buckled [rad]."""
_POSE_TOLERANCE = 0.01
"""Share of the length by which a pose may miss: near its fold a loaded limb reaches less far than
the arcs of a named motion."""
_SPARSE = 5
"""Every so many poses one is taken to find what the limb could carry."""


class Configuration(ABC):
    """A model's bend angles along a reference, and the pressures that they need.

    Args:
        model: of the limb.
        bend: bend angles (M,) [rad] over time.
        start: where the motion begins; None: at rest.
    """

    def __init__(self, model: Model, bend: BSpline, start: Start | None) -> None:
        self.model, self.bend, self.start = model, bend, start

    def bend_at(self, time: Array) -> Array:
        """Return the bend angles (…, M) [rad] at instants (…,) [s]."""
        return sample_spline(self.bend, time)[0]

    def with_model(self, model: Model) -> Configuration:
        """Return the same motion for the model of another limb with as many segments."""
        other = copy.copy(self)
        other.model = model
        return other

    def near(self, time: Array) -> TipOfBend:  # noqa: ARG002 - evenly bent, it is always the same
        """Return the tip for bend angles (K, M) near those of the motion at instants (K,) [s]."""
        return self.model.kinematics

    def curves(self, time: Array) -> Array:
        """Return the centreline (K, P, 2) [m] at instants (K,) [s]."""
        return np.stack([self.model.kinematics.curve(bend) for bend in self.bend_at(time)])

    def response(self, commands: Array, bend: Bend | None = None) -> Response:
        """Return the model's response to commands (K, M) [Pa] from the motion's beginning.

        Args:
            commands: (K, M) [Pa].
            bend: along which friction and creep act; None: along the bend that these commands lead
                to.

        Raises:
            ConvergenceError: the model cannot be rolled forward under them.
        """
        instants = np.arange(len(commands)) * CONTROL_PERIOD
        return simulate(self.model, instants, commands=commands, bend=bend, initial=self.initial)

    @property
    def initial(self) -> Initial:
        """State and command with which the motion begins."""
        return Initial(self.begin, None if self.start is None else self.start.pressure)

    @property
    def begin(self) -> State:
        """State in which the motion begins: at rest, or where another motion is left."""
        if self.start is None:
            return self.model.rest
        return self.model.state(self.bend(0.0), self.bend(0.0, 1))

    @abstractmethod
    def pressures(self, method: str, time: Array) -> Array:
        """Return effective pressures (K, M) [Pa] by ``paper`` or ``projected``.

        Args:
            method: of the two.
            time: (K,) evenly spaced instants from 0 on [s].
        """


def configure(model: Model, reference: Reference) -> Configuration:
    """Return the configuration of a model that follows r̄(t).

    Raises:
        UnreachableError: a point is out of reach of the model, or beyond the pressure limit.
        OverloadError: gravity's load takes more than the pressure limit.
        BucklingError: the model does not stay at a pose on the way, or does not rest.
    """
    if isinstance(model, RodModel):
        along = _poses_along if model.is_loaded else _evenly_along
        return along(model, reference)
    if not isinstance(model, ArcModel):
        raise TypeError(f"expected a rod or arcs, got {type(model).__name__}")
    try:
        return _arcs_along(model, reference)
    except PlanningError as error:
        if not model.limb.gravity[2]:
            raise
        raise PlanningError(
            f"{error}. Arcs know nothing of the sag out of their plane that this gravity brings: "
            "plan with the rod (der)"
        ) from error


# Arcs ------------------------------------------------------------------------------------------


class ArcConfiguration(Configuration):
    """Arcs along a reference."""

    model: ArcModel

    def pressures(self, method: str, time: Array) -> Array:  # noqa: ARG002 - both are the same
        """Return u = Λ† (M q̈ + (C + D) q̇ + K q − Q_gravity) at instants (K,) [s]."""
        return self.model.inverse_dynamics(*sample_spline(self.bend, time))


def _arcs_along(model: ArcModel, reference: Reference) -> ArcConfiguration:
    """Return q̄(t) itself: the reference is made of arcs.

    Under gravity the arcs rest elsewhere than the rod whose rest the reference begins with: there
    they follow r̄(t) from their own rest.
    """
    time, tip, angles = reference.time, reference.tip, reference.bend_angles
    if not model.is_loaded:
        Workspace(model).check_reach(time, tip, angles, np.zeros(len(time)))
        return ArcConfiguration(model, reference.spline, reference.start)
    home = model.rest.angles
    if np.abs(home - reference.rest).max() > _FALLEN:
        raise BucklingError(
            "the arcs fall over under their load where the rod stands: make the limb lighter "
            "or stiffer, or mount it otherwise"
        )
    near = angles + (home - reference.rest)
    # Points that the rod reaches and the arcs miss are no refusal: the plan's error shows them.
    own = inverse_kinematics(model, tip, near, REFERENCE_PRIOR)[0]

    def needed(arcs: ArcModel) -> Array:
        return arcs.material.differential_pressure(time, arcs.static_pressure(own), own)

    stiffness = np.array([model.smallest_stiffness(pose) for pose in own])
    check_stays(stiffness, time, tip, "arcs")
    check_load(model, time, tip, needed(model), needed)
    return ArcConfiguration(model, resting_spline(time, own, reference.start), reference.start)


# Rods ------------------------------------------------------------------------------------------


class RodConfiguration(Configuration):
    """A rod without gravity along a reference: its segments bend evenly."""

    model: RodModel

    def pressures(self, method: str, time: Array) -> Array:
        """Return effective pressures (K, M) [Pa], see `Configuration.pressures`."""
        bend = sample_spline(self.bend, time)
        if method != "paper":
            return self.model.balance.projected(*bend)
        q, v, a = (coordinates(part) for part in self.model.kinematics.motion(*bend))
        rod, rest = self.model.rod, self.model.rest
        moving = [rod.state(place, rate, like=rest) for place, rate in zip(q, v, strict=True)]
        pressures, inverse = _least_squares(*_equation_of_motion(rod, moving, a))
        return self._beside_the_model(pressures, inverse, q, v, time)

    def _beside_the_model(
        self, pressures: Array, inverse: Array, position: Array, velocity: Array, time: Array
    ) -> Array:
        """Return the pressures (K, M) with (B Λ)† M (K_d ė + K_p e) added.

        The rod is simulated beside the equation, under the pressures that it has given so far; e
        is its distance from the reference.

        Args:
            pressures: (K, M) of the equation without e [Pa].
            inverse: (K, M, F) (B Λ)† on the free rows.
            position: (K, 4N-1) of the reference.
            velocity: (K, 4N-1) of the reference.
            time: (K,) [s].
        """
        rod, result = self.model.rod, pressures.copy()
        mass, step = rod.mass_diagonal[rod.free], float(time[1] - time[0])
        state = self.begin
        if not isinstance(state, RodState):
            raise TypeError("a rod begins in a state of the rod")
        for k in range(len(result)):
            gap, rate = (position[k] - state.q)[rod.free], (velocity[k] - state.v)[rod.free]
            result[k] += inverse[k] @ (mass * (VELOCITY_GAIN * rate + POSITION_GAIN * gap))
            state = rod.simulate(state, result[k, None], step, substeps=2).final
        return result


def _evenly_along(model: RodModel, reference: Reference) -> RodConfiguration:
    time, tip, guess = reference.time, reference.tip, reference.bend_angles
    if model.inputs == 1:
        # One angle cannot follow two coordinates: the rod bends as the arc does.
        bend = resting_spline(time, guess, reference.start)
        return RodConfiguration(model, bend, reference.start)
    space, shape = Workspace(model), model.kinematics
    bounds, tolerance = None, TOLERANCE
    if reference.deviation is not None:
        # At the edge of what arcs reach the polyline would need more than the pressure limit for
        # the last millimetres: they are left out, and the predicted error shows them.
        bounds, tolerance = (space.low + _INSIDE, space.high - _INSIDE), NEAREST_TOLERANCE
    angles, misses = inverse_kinematics(shape, tip, guess, REFERENCE_PRIOR, bounds)
    space.check_reach(time, tip, angles, misses, tolerance, shape)
    return RodConfiguration(model, resting_spline(time, angles, reference.start), reference.start)


class LoadedConfiguration(RodConfiguration):
    """A rod under gravity along a reference: a row of its own resting poses.

    Args:
        model: of the limb.
        time: (K,) of the poses [s].
        poses: at these instants.
        start: where the motion begins; None: at rest.
    """

    def __init__(self, model: RodModel, time: Array, poses: Poses, start: Start | None) -> None:
        super().__init__(model, _through(time, poses.bend_angles, start), start)
        self._time, self._poses = time, poses
        self._shape = _through(time, np.array([state.q for state in poses.states]), start)

    @property
    def begin(self) -> RodState:
        """State in which the motion begins."""
        if self.start is None:
            return self.model.rest
        q, v, _ = sample_spline(self._shape, 0.0)
        return self.model.rod.state(q, v, like=self._poses.states[0])

    def near(self, time: Array) -> TipOfBend:
        """Return the tip for bend angles near those of the poses, see `Configuration.near`."""
        slopes = self._poses.tip_by_bend(self.model.rod)
        slope = interpolate(time, self._time, slopes.reshape(len(slopes), -1))
        return TipNearPoses(
            self.model.kinematics,
            self.bend_at(time),
            self.curves(time)[:, -1],
            slope.reshape(len(time), 2, -1),
        )

    def curves(self, time: Array) -> Array:
        """Return the centreline of the poses, see `Configuration.curves`."""
        q = sample_spline(self._shape, time)[0]
        nodes = np.stack([q[:, 0::4], q[:, 1::4]], axis=-1)
        clamp = np.zeros((len(nodes), 1 if self.model.kinematics.base else 0, 2))
        return np.concatenate([clamp, nodes], axis=1)

    def pressures(self, method: str, time: Array) -> Array:
        """Return effective pressures (K, M) [Pa] along the poses, see the module."""
        _, v, a = sample_spline(self._shape, self._time)
        moving = [replace(s, v=rate) for s, rate in zip(self._poses.states, v, strict=True)]
        forces, inputs = _equation_of_motion(self.model.rod, moving, a)
        if method != "paper":
            work = np.einsum("kfm,kf->km", self._poses.tangents, forces)
            by_pressure = np.einsum("kfm,kfn->kmn", self._poses.tangents, inputs)
            found = np.linalg.solve(by_pressure, work[..., None])[..., 0]
            return interpolate_smoothly(time, self._time, found)
        found, inverse = _least_squares(forces, inputs)
        pressures = interpolate_smoothly(time, self._time, found)
        nearest = np.rint(np.interp(time, self._time, np.arange(len(self._time)))).astype(int)
        position, velocity, _ = sample_spline(self._shape, time)
        return self._beside_the_model(pressures, inverse[nearest], position, velocity, time)


def _equation_of_motion(
    rod: Rod, moving: list[RodState], acceleration: Array
) -> tuple[Array, Array]:
    """Return M q̈ + D q̇ − F_int − F_ext (K, F) [N] and B Λ (K, F, M) [N/Pa] on the free rows.

    Args:
        rod: of the states.
        moving: K states.
        acceleration: (K, 4N-1) q̈.
    """
    velocity = np.array([state.v for state in moving])
    supplied = np.array([rod.internal_force(state) for state in moving]) + rod.external_force
    forces = rod.mass_diagonal * acceleration + rod.damping_diagonal * velocity - supplied
    inputs = np.array([rod.input_matrix(state)[rod.free] for state in moving])
    return forces[:, rod.free], inputs


def _least_squares(forces: Array, inputs: Array) -> tuple[Array, Array]:
    """Return the paper's pressures (K, M) [Pa], (B Λ)† times the forces, and (B Λ)† (K, M, F)."""
    inverse = np.asarray(np.linalg.pinv(inputs), dtype=np.float64)
    return (inverse @ forces[..., None])[..., 0], inverse


def interpolate_smoothly(time: Array, instants: Array, values: Array) -> Array:
    """Return values (K, M) at instants (K,) as (…, M) at others, by a spline."""
    return sample_spline(resting_spline(instants, values), time)[0]


def _through(time: Array, values: Array, start: Start | None) -> BSpline:
    """Return the spline through (K, n) values; one that another motion precedes begins moving."""
    if start is None:
        return resting_spline(time, values)
    passing = make_interp_spline(time, values, k=5)
    begin = replace(start, rate=passing(0.0, 1), acceleration=passing(0.0, 2))
    return resting_spline(time, values, begin)


def _poses_along(model: RodModel, reference: Reference) -> LoadedConfiguration:
    """Return the poses of a loaded rod along a reference."""
    count = max(8, int(np.ceil(reference.duration / POSE_PERIOD)) + 1)
    time = np.linspace(0.0, reference.duration, count)
    tip = interpolate_smoothly(time, reference.time, reference.tip)
    # The rod's own bend angles where it rests: there the poses begin and end without pressure.
    home = model.bend_of(stable_rest(model))
    guess = reference.sample(time)[0] + (home - reference.rest)
    poses = _find_poses(model, time, tip, guess)
    pressure = _needed(model, time, poses)
    worst = int(np.abs(pressure).max(axis=1).argmax())
    some = np.unique(np.append(np.arange(0, count, _SPARSE), [0, worst, count - 1]))

    def needed(lighter: RodModel) -> Array:
        fewer = _find_poses(lighter, time[some], tip[some], guess[some])
        return _needed(lighter, time[some], fewer)

    check_load(model, time, tip, pressure, needed)
    return LoadedConfiguration(model, time, poses, reference.start)


def _find_poses(model: RodModel, time: Array, tip: Array, guess: Array) -> Poses:
    """Return the poses with tips (K, 2) [m], near bend angles (K, M) [rad].

    Raises:
        BucklingError: the rod would buckle or snap through on the way.
        UnreachableError: a pose misses its point.
    """
    finder = PoseFinder(model, REFERENCE_PRIOR)
    poses = held_poses(finder, stable_rest(model), time, tip, guess)
    check_stays(poses.smallest_stiffness, time, tip, "limb")
    missed = poses.misses > _POSE_TOLERANCE * model.limb.length
    if missed.any() and model.inputs > 1:
        k = int(np.argmax(missed))
        carried = sum(item.mass for item in model.limb.masses)
        raise UnreachableError(float(time[k]), tip[k], float(poses.misses[k]), math.nan, carried)
    return poses


def _needed(model: RodModel, time: Array, poses: Poses) -> Array:
    """Return the differential pressures (K, M) [Pa] at which poses rest."""
    try:
        return model.material.differential_pressure(time, poses.pressures, poses.bend_angles)
    except ValueError as error:
        raise PlanningError(str(error)) from error
