"""Poses in which pressures hold a loaded rod at rest so that its tip is where it is wanted.

Under gravity a rod that its pressures hold does not bend evenly. Its resting shape q(w) under
effective pressures w is found by Newton's method, and w from the wanted tip r by damped least
squares on

    a² |tip(q(w)) − r|² + p² |θ(q(w)) − θ̄|²

with θ the bend angles and θ̄ a guess that decides what the tip leaves open, or with a = 0 the wanted
bend. Along a path each pose starts from the one before it, so that the branch is kept by
continuity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from der_planner.arrays import Array
from der_planner.model.bending import bend_angles, bend_change, bend_outputs
from der_planner.model.rod import RodModel
from der_planner.rod import ConvergenceError, RodState

_ITERATIONS = 30
_SMALL = 1e-7
"""Change of the bend angles that ends the search for a pose [rad]."""
_STRIDE = 0.2
"""Largest change of a bend angle in one iteration [rad]."""
_APPROACH = 0.01
"""Steps in which the tip is led to the first point of a path [m]."""


@dataclass(frozen=True)
class Poses:
    """K poses of a rod, each at rest under its own effective pressures.

    Attributes:
        pressures: (K, M) effective [Pa].
        states: (K,) of the rod.
        bend_angles: (K, M) [rad].
        tangents: (K, F, M) ∂q/∂pressures on the rod's free rows [m/Pa].
        misses: (K,) distance of the tip from where it was wanted [m].
        smallest_stiffness: (K,) smallest eigenvalue of the static stiffness; zero or below: the rod
            does not stay in this pose.
    """

    pressures: Array
    states: tuple[RodState, ...]
    bend_angles: Array
    tangents: Array
    misses: Array
    smallest_stiffness: Array


class PoseFinder:
    """Finds poses of one rod.

    Args:
        model: of a limb under gravity.
        prior: p [m/rad].
        tip_weight: a.
    """

    def __init__(self, model: RodModel, prior: float, tip_weight: float = 1.0) -> None:
        self._model, self.rod, self.gain = model, model.rod, model.limb.static_gain
        self.prior, self.tip_weight = prior, tip_weight
        tip = 4 * (self.rod.nodes - 1)
        self._tip = [tip, tip + 1]
        self._outputs = bend_outputs(self.rod)

    def along(self, start: RodState, tip: Array, guess: Array) -> Poses:
        """Return the poses for tips (K, 2) [m], near bend angles (K, M) [rad].

        Args:
            start: rests under no pressure; the search begins there.
            tip: wanted.
            guess: θ̄.

        Raises:
            ConvergenceError: the rod has no pose that goes on from the last one; `step` is the
                index of the point.
        """
        state, pressure = start, np.zeros(self.rod.segment_count)
        begin = state.q[self._tip]
        count = int(np.ceil(np.linalg.norm(tip[0] - begin) / _APPROACH))
        angles = self._model.bend_of(state)
        for share in np.arange(1, count) / max(count, 1):
            wanted, near = begin + share * (tip[0] - begin), angles + share * (guess[0] - angles)
            state, pressure = self._pose(state, pressure, wanted, near, 0)
        found: list[tuple[Array, RodState]] = []
        for k in range(len(tip)):
            ahead = pressure if len(found) < 2 else 2 * found[-1][0] - found[-2][0]
            try:
                state, pressure = self._pose(state, ahead, tip[k], guess[k], k)
            except ConvergenceError:
                state, pressure = self._pose(state, pressure, tip[k], guess[k], k)
            found.append((pressure, state))
        return self._described(found, tip)

    def _described(self, found: list[tuple[Array, RodState]], tip: Array) -> Poses:
        rod, q = self.rod, np.array([state.q for _, state in found])
        slopes = [rod.linearise_equilibrium(state, u)[rod.free] for u, state in found]
        return Poses(
            np.array([u for u, _ in found]),
            tuple(state for _, state in found),
            bend_angles(rod, q),
            np.array(slopes),
            np.linalg.norm(q[:, self._tip] - tip, axis=1),
            np.array([rod.smallest_stiffness(state, u) for u, state in found]),
        )

    def _pose(
        self, state: RodState, pressure: Array, tip: Array, guess: Array, index: int
    ) -> tuple[RodState, Array]:
        """Return the pose and its pressures (M,) for one tip, going there from another pose."""
        state = self._at_rest(pressure, state, index)
        misses = self._misses(state, tip, guess)
        damping = 1e-9
        for _ in range(_ITERATIONS):
            jacobian = self._jacobian(state, pressure)
            normal = jacobian.T @ jacobian
            normal[np.diag_indices(len(normal))] += damping
            change = -np.linalg.solve(normal, jacobian.T @ misses)
            change *= min(1.0, _STRIDE / max(float(np.abs(change).max()), 1e-300))
            try:
                trial = self._at_rest(pressure + change / self.gain, state, index)
            except ConvergenceError:
                damping = max(100 * damping, 1e-5)
                if damping > 1e6:
                    raise
                continue
            new = self._misses(trial, tip, guess)
            if new @ new > (misses @ misses) * (1 + 1e-12) + 1e-24:
                damping = max(10 * damping, 1e-6)
                if damping > 1e3:
                    break
                continue
            state, pressure, misses = trial, pressure + change / self.gain, new
            damping = max(damping / 10, 1e-12)
            if np.abs(change).max() < _SMALL:
                break
        return state, pressure

    def _at_rest(self, pressure: Array, start: RodState, index: int) -> RodState:
        try:
            return self.rod.equilibrium(pressure, start=start)
        except ConvergenceError as error:
            error.step = index
            raise

    def _misses(self, state: RodState, tip: Array, guess: Array) -> Array:
        angles = self._model.bend_of(state)
        missed = self.tip_weight * (state.q[self._tip] - tip)
        return np.concatenate([missed, self.prior * (angles - guess)])

    def _jacobian(self, state: RodState, pressure: Array) -> Array:
        """Return ∂misses/∂(pressures times gain) (2 + M, M)."""
        slope = self.rod.linearise_equilibrium(state, pressure) / self.gain
        q = np.tile(state.q, (slope.shape[1], 1))
        bend = bend_change(self.rod, q, slope[self._outputs].T)
        return np.concatenate([self.tip_weight * slope[self._tip], self.prior * bend.T])
