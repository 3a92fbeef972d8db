"""Time integration: the methods, each a chain of backward Euler solves."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from der_planner.rod.backend import Run, Solves
from der_planner.rod.errors import ConvergenceError
from der_planner.rod.mesh import array, require
from der_planner.rod.planar import PlanarBackend
from der_planner.rod.spatial import SpatialBackend
from der_planner.rod.state import Array, RodState

Method = Literal["sdirk2", "midpoint", "backward_euler"]

# Each method is a chain of backward Euler solves over fraction·dt from (q, v), after each of which
# the state goes on to (q, v) + e ((q', v') − (q, v)). e = 2 is the implicit midpoint rule; γ = 1 −
# 1/√2 with e = (1 − γ)/γ, then 1, is Alexander's two-stage SDIRK: second order and L-stable.
_LIMIT = 30  # Newton iterations of a step
_GAMMA = 1.0 - math.sqrt(0.5)
_STAGES = {
    "backward_euler": (1.0, np.array([1.0])),
    "midpoint": (0.5, np.array([2.0])),
    "sdirk2": (_GAMMA, np.array([(1.0 - _GAMMA) / _GAMMA, 1.0])),
}


def stage_count(method: str) -> int:
    """Return how many solves a step of this method takes."""
    return len(_STAGES[method][1])


def by_step(pressures: ArrayLike, substeps: int, segment_count: int) -> Array:
    """Return pressures (K, M) or (K, substeps, M) as (K, substeps, M).

    Raises:
        ValueError: another shape, a value that is not finite, or no positive number of substeps.
    """
    require(isinstance(substeps, (int, np.integer)) and substeps > 0, "substeps",
            "an int of 1 or more", substeps)  # fmt: skip
    given = np.asarray(pressures, dtype=np.float64)
    require(given.ndim in (2, 3), "pressures", "(K, M) or (K, substeps, M)", given.shape)
    intervals = given.shape[0]
    if given.ndim == 2:
        array(given, (intervals, segment_count), "pressures")
        given = np.repeat(given[:, None, :], substeps, axis=1)
    return array(given, (intervals, substeps, segment_count), "pressures")


class Integrator:
    """Runs a backend by one of the methods.

    Args:
        backend: of the rod.
        tolerance: largest last Newton update [m].
    """

    def __init__(self, backend: PlanarBackend | SpatialBackend, tolerance: float) -> None:
        self._backend = backend
        self._tolerance = tolerance

    def run(
        self,
        state: RodState,
        pressures: Array,
        dt: float,
        method: str,
        load: Array,
        linearise: bool = False,
    ) -> Run:
        """Run K intervals of S steps of dt under pressures (K, S, M) and load (4N-1,).

        Raises:
            ConvergenceError: with the step's index and the last good state.
        """
        solves = self._solves(dt, method, load)
        stages = len(solves.extrapolate)
        if stages > 1:
            pressures = np.repeat(pressures, stages, axis=1)
        run = self._backend.simulate(state, pressures, solves, linearise)
        if run.failed_iterations:
            raise _failure(run, dt, method)
        return run

    def linearise(
        self, state: RodState, u: Array, dt: float, method: str, load: Array
    ) -> tuple[Array, Array]:
        """Return (A, B) of one step under pressures u (M,) and load (4N-1,).

        Raises:
            ConvergenceError: a solve failed.
        """
        run, matrices = self._backend.linearise(state, u, self._solves(dt, method, load))
        if matrices is None:
            raise _failure(run, dt, method)
        return matrices

    def _solves(self, dt: float, method: str, load: Array) -> Solves:
        require(method in _STAGES, "method", f"one of {sorted(_STAGES)}", method)
        fraction, extrapolate = _STAGES[method]
        return Solves(dt * fraction, extrapolate, load, self._tolerance, _LIMIT)


def _failure(run: Run, dt: float, method: str) -> ConvergenceError:
    step = run.steps // stage_count(method)
    return ConvergenceError(
        f"step {step} of {dt:g} s ({method}) did not converge in "
        f"{run.failed_iterations} Newton iterations "
        f"(last update {run.update:.3g} m): take a shorter step",
        step=step, residual=run.update, iterations=run.failed_iterations, state=run.final,
    )  # fmt: skip
