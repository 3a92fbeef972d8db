"""What the planar and the spatial backend take and return."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from der_planner.rod.linearisation import StageStates, StepFactors
from der_planner.rod.state import Array, RodState


@dataclass(frozen=True)
class Solves:
    """How a backend steps: backward Euler solves, after each of which the state goes on.

    Attributes:
        h: time over which each solve goes [s].
        extrapolate: (P,) factors e: after a solve the state goes on to (q, v) + e ((q', v') −
            (q, v)), with one e after the other.
        load: (4N-1,) gravity and point forces.
        tolerance: largest last Newton update [m].
        limit: most Newton iterations of a solve.
    """

    h: float
    extrapolate: Array
    load: Array
    tolerance: float
    limit: int


@dataclass(frozen=True)
class Run:
    """What a backend's simulation returned.

    Attributes:
        q: (K+1, 4N-1). v: likewise.
        final: the last converged state.
        steps: steps done. iterations: Newton iterations of all of them.
        update: size of the last Newton update if a step failed.
        failed_iterations: iterations of the failed step, 0 if none failed.
        factors: the linearisation, if asked for. stages: the states that it belongs to.
    """

    q: Array
    v: Array
    final: RodState
    steps: int
    iterations: int
    update: float
    failed_iterations: int
    factors: StepFactors | None
    stages: StageStates | None = None


def band_to_dense(band: Array) -> Array:
    """Return the full matrix of a symmetric band stored by columns."""
    size, width = band.shape
    result = np.diag(band[:, 0].copy())
    for k in range(1, width):
        rows = np.arange(k, size)
        result[rows, rows - k] = band[: size - k, k]
        result[rows - k, rows] = band[: size - k, k]
    return result
