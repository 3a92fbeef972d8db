"""Many rods in one call, on all cores of the machine.

Planar rods run through one compiled loop a thread, which holds no interpreter lock; rods in space
through one compiled call each. Either way a run is that of `Rod.simulate`, whatever runs beside it.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from der_planner.rod.errors import ConvergenceError
from der_planner.rod.integration import Method, solver_of
from der_planner.rod.mesh import array, positive, require
from der_planner.rod.planar.backend import PlanarBackend
from der_planner.rod.planar.elastic_kernel import PlanarRod
from der_planner.rod.planar.many_kernel import simulate_range
from der_planner.rod.rod import Rod
from der_planner.rod.state import Array, RodState
from der_planner.rod.step_kernel import Body

_SHARES = 8
"""Pieces of work a thread: runs differ in their Newton iterations."""
Thing = TypeVar("Thing")


@dataclass(frozen=True)
class ManyRuns:
    """R motions of K intervals.

    Attributes:
        outputs: (R, K+1, P) coordinates of q that were asked for [m, rad].
        final: (R,) states at the end.
    """

    outputs: Array
    final: tuple[RodState, ...]


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def in_threads(work: Callable[[int], Thing], count: int, threads: int | None = None) -> list[Thing]:
    """Return work(0) … work(count − 1), done in several threads; default one for each core.

    After an error nothing more is begun, and the error of the first of them is raised.
    """
    with ThreadPoolExecutor(max(1, min(threads or cores(), count))) as pool:
        waiting = [pool.submit(work, index) for index in range(count)]
        try:
            return [each.result() for each in waiting]
        finally:
            for each in waiting:
                each.cancel()


@contextlib.contextmanager
def naming(run: int) -> Iterator[None]:
    """Say in a `ConvergenceError` which run it was."""
    try:
        yield
    except ConvergenceError as error:
        raise ConvergenceError(
            f"run {run}: {error}", step=error.step, residual=error.residual,
            iterations=error.iterations, state=error.state,
        ) from error  # fmt: skip


def one_each(given: Thing | Sequence[Thing], runs: int, name: str) -> list[Thing]:
    """Return one thing for each run: the same for all, or as many as there are runs.

    Raises:
        ValueError: there are more or fewer.
    """
    if not isinstance(given, (list, tuple)):
        return [cast("Thing", given)] * runs
    require(len(given) == runs, name, f"one, or one for each of the {runs} runs", len(given))
    return list(given)


def simulate_many(
    rods: Rod | Sequence[Rod],
    states: RodState | Sequence[RodState],
    pressures: ArrayLike,
    dt: float,
    *,
    substeps: int = 1,
    method: Method = "sdirk2",
    outputs: Sequence[int] | None = None,
    threads: int | None = None,
) -> ManyRuns:
    """Simulate R rods, K intervals of length dt each.

    Args:
        rods: one for all runs, or a list of R with the same nodes, segment count, clamp and plane.
        states: initial state of all runs, or a list of R.
        pressures: (R, K, M) held over each interval, or (R, K, substeps, M) one for each step [Pa].
        dt: length of an interval [s].
        substeps: S, integrator steps in an interval.
        method: as in `Rod.step`.
        outputs: (P,) indices into q of what is kept; default the tip's free coordinates.
        threads: at most so many; default one for each core.

    Raises:
        ValueError: a shape does not fit, or rods differ in more than their numbers.
        ConvergenceError: a step of a run did not converge, however short; names the run.
    """
    given = np.asarray(pressures, dtype=np.float64)
    require(given.ndim in (3, 4) and len(given) > 0, "pressures",
            "(R, K, M) or (R, K, substeps, M) with one run or more", given.shape)  # fmt: skip
    runs = len(given)
    rod_of, state_of = one_each(rods, runs, "rods"), one_each(states, runs, "states")
    crowd = _Crowd(rod_of)
    if given.ndim == 3:
        given = np.repeat(given[:, :, None, :], substeps, axis=2)
    held = array(given, (runs, given.shape[1], substeps, crowd.inputs), "pressures")
    wanted = rod_of[0].output_indices(outputs)
    interval = positive(dt, "dt")

    def alone(run: int) -> tuple[Array, RodState]:
        with naming(run):
            motion = rod_of[run].simulate(
                state_of[run], held[run], interval, substeps=substeps, method=method
            )
        return motion.q[:, wanted], motion.final

    if crowd.planar is None:
        found = in_threads(alone, runs, threads)
        return ManyRuns(np.stack([q for q, _ in found]), tuple(final for _, final in found))
    out, final, failed = crowd.run(state_of, held, interval / substeps, method, wanted, threads)
    # Steps that have to be cut in two are rare: their runs are done again by the rod alone.
    for run, (q, last) in zip(failed, in_threads(lambda i: alone(failed[i]), len(failed), threads),
                              strict=True):  # fmt: skip
        out[run], final[run] = q, last
    return ManyRuns(out, tuple(final))


class _Crowd:
    """The rods of R runs, each distinct one once, as the planar kernel takes them.

    Attributes:
        inputs: M.
        planar: the distinct backends if the rods move in a plane, else None.
    """

    def __init__(self, rod_of: Sequence[Rod]) -> None:
        self._rods = list({id(rod): rod for rod in rod_of}.values())
        place = {id(rod): index for index, rod in enumerate(self._rods)}
        self._which = np.array([place[id(rod)] for rod in rod_of], dtype=np.int64)
        first = self._rods[0]
        self.inputs = first.segment_count
        for index, rod in enumerate(self._rods):
            for name in ("nodes", "segment_count", "plane"):
                mine, its = getattr(first, name), getattr(rod, name)
                require(mine == its, f"rods: {name} of distinct rod {index}", f"{mine}", its)
        backends = [rod.backend for rod in self._rods]
        held = all(np.array_equal(each.fixed, backends[0].fixed) for each in backends)
        require(held, "rods", "clamped alike", "different clamps")
        flat = [each for each in backends if isinstance(each, PlanarBackend)]
        self.planar = flat if len(flat) == len(backends) else None

    def run(
        self, state_of: Sequence[RodState], held: Array, h: float, method: Method,
        outputs: NDArray[np.int64], threads: int | None,
    ) -> tuple[Array, list[RodState], list[int]]:  # fmt: skip
        """Return the outputs (R, K+1, P), the states at the end and the runs that failed."""
        assert self.planar is not None
        runs, intervals = held.shape[:2]
        backends, one = self.planar, self.planar[0]
        lengths = np.array([float(each.mesh.rest.sum()) for each in backends])
        solver = solver_of(method, h, 1.0, one.lever)
        bodies = Body(
            np.stack([each.mass for each in backends]),
            np.stack([each.damping for each in backends]),
            np.stack([each.body(rod.external_force).load for each, rod in
                      zip(backends, self._rods, strict=True)]),
            one.fixed,
        )  # fmt: skip
        rods = PlanarRod(
            *(np.stack(parts) for parts in zip(*(e.rod for e in backends), strict=True))
        )
        places = [backends[i].place(state) for i, state in zip(self._which, state_of, strict=True)]
        x, v = np.stack([p.x for p in places]), np.stack([p.v for p in places])
        rows, record = one.rows(outputs), one.new_record(0)
        out = np.empty((runs, intervals + 1, len(rows)))
        failed = np.empty(runs, dtype=np.int64)
        share = max(1, -(-runs // ((threads or cores()) * _SHARES)))

        def work(piece: int) -> None:
            q, rate = np.empty((2, intervals + 1, one.size))
            simulate_range(
                piece * share, min((piece + 1) * share, runs), self._which, x, v, held, rows, out,
                failed, solver, solver.tolerance * lengths, record, q, rate, one.work_space(),
                bodies, rods,
            )  # fmt: skip

        in_threads(work, -(-runs // share), threads)
        final = [
            backends[i].state(replace(place, x=x[run], v=v[run]), state_of[run])
            for run, (i, place) in enumerate(zip(self._which, places, strict=True))
        ]
        return out, final, [int(run) for run in np.flatnonzero(failed >= 0)]
