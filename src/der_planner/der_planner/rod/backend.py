"""What the planar and the spatial backend take and return."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from der_planner.rod.mesh import Mesh
from der_planner.rod.state import Array, RodState
from der_planner.rod.step_kernel import Body, Record, Solver


@dataclass(frozen=True)
class Place:
    """Where a run is, in the kernels' coordinates; the kernels move it on.

    Attributes:
        x: (n,) positions and angles. v: (n,) their rate.
        tangents: (edges, 3) and directors: (edges, 3) of the reference frames, twists: (nodes,);
            empty for a planar rod.
    """

    x: Array
    v: Array
    tangents: Array
    directors: Array
    twists: Array


@dataclass(frozen=True)
class Piece:
    """What one call of a simulation kernel did.

    Attributes:
        done: index of the step that failed, or the number of all steps.
        iterations: Newton iterations. update: size of the last update [m].
        failed_iterations: of the solve that failed, 0 if none did.
        record: the linearisation; only the solves of the steps done are filled.
    """

    done: int
    iterations: int
    update: float
    failed_iterations: int
    record: Record


class Backend(Protocol):
    """What integration, linearisation and statics need of a planar or a spatial rod."""

    mesh: Mesh
    index: NDArray[np.int64]  # indices into q of the coordinates that the kernels have
    offset: int  # kernel unknowns of the ghost node, before those of q
    size: int  # n
    fixed: NDArray[np.int64]  # kernel unknowns that do not move
    free: NDArray[np.int64]  # indices into q that move
    free_rows: NDArray[np.int64]  # the same as kernel unknowns
    mass: Array  # (n,)
    damping: Array  # (n,)
    lever: float  # an angle counts times this as a length [m]

    def place(self, state: RodState) -> Place:
        """Return a state in the kernels' coordinates, free to be changed."""
        ...

    def state(self, place: Place, like: RodState) -> RodState:
        """Return the public state at a place; what a plane does not have is as in `like`."""
        ...

    def restore(self, x: Array, base: Array) -> Array:
        """Return (…, 4N-1) from kernel coordinates (…, n); what they lack is as in `base`."""
        ...

    def body(self, load: Array) -> Body:
        """Return what moves under a load (4N-1,)."""
        ...

    def new_record(self, solves: int) -> Record:
        """Return an unfilled record of so many solves."""
        ...

    def simulate(
        self, place: Place, motion: tuple[Array, Array], pressures: Array, begin: int,
        solver: Solver, load: Array, record: Record,
    ) -> Piece:  # fmt: skip
        """Run the kernel from step `begin` on; motion is where positions and velocities go."""
        ...


def band_to_dense(band: Array) -> Array:
    """Return the full matrix of a symmetric band stored by columns."""
    size, width = band.shape
    result = np.diag(band[:, 0].copy())
    for k in range(1, width):
        rows = np.arange(k, size)
        result[rows, rows - k] = band[: size - k, k]
        result[rows - k, rows] = band[: size - k, k]
    return result


def general_band_to_dense(band: Array) -> Array:
    """Return the full matrix of a general band stored by rows."""
    size, width = band.shape
    half = (width - 1) // 2
    result = np.zeros((size, size))
    for row in range(size):
        first, last = max(0, row - half), min(size, row + half + 1)
        result[row, first:last] = band[row, first - row + half : last - row + half]
    return result
