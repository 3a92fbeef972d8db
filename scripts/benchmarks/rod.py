"""The rod's kernels beside PyElastica, on the cantilever that is released under its weight."""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import show
from der_planner.rod import Rod

Figures = dict[str, float | str]

LENGTH, RADIUS, YOUNG, DENSITY, GRAVITY = 0.25, 0.015, 1.5e6, 1240.0, -9.81
AREA = np.pi * RADIUS**2
INERTIA = 0.25 * np.pi * RADIUS**4
SHEAR = YOUNG / 3.0


class TimedRun(NamedTuple):
    """One timed simulation, of 1 s if nobody said more."""

    tip: NDArray[np.float64]
    """(3,) Displacement of the tip at the end [m]."""
    seconds: float
    """Wall time."""
    steps: int
    iterations: int = 0
    """Newton's."""


def cantilever(
    nodes: int = 21, clamp: str = "ghost", plane: str | None = "xz", **options: Any
) -> Rod:
    """Return the cantilever of the design's check values; more options as of `Rod.uniform`."""
    usual = {"EA": YOUNG * AREA, "gravity": (0, 0, GRAVITY)}
    return Rod.uniform(
        length=LENGTH, nodes=nodes, EI=YOUNG * INERTIA, GJ=SHEAR * 2 * INERTIA,
        mass_per_length=DENSITY * AREA, clamp=clamp, plane=plane, **(usual | options),
    )  # fmt: skip


def run_rod(rod: Rod, dt: float, method: str, repetitions: int = 1) -> TimedRun:
    """Release the cantilever for 1 s; the best wall time of several repetitions."""
    start = rod.straight_state()
    still = np.zeros((round(1.0 / dt), rod.segment_count))
    best = np.inf
    for _ in range(repetitions):
        begin = time.perf_counter()
        motion = rod.simulate(start, still, dt, method=method)
        best = min(best, time.perf_counter() - begin)
    return TimedRun(motion.tip[-1] - motion.tip[0], best, len(still), motion.newton_iterations)


def run_elastica(
    elements: int, dt: float, simulated: float = 1.0, *, shear_factor: float = 1.0
) -> TimedRun:
    """Release the same cantilever in PyElastica, its shear stiffness times `shear_factor`."""
    import elastica as ea  # noqa: PLC0415 - heavy, and only this peer needs it

    class Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing):
        """A rod with a clamp under gravity."""

    simulator = Simulator()
    rod = ea.CosseratRod.straight_rod(
        elements, np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), LENGTH, RADIUS,
        DENSITY, youngs_modulus=YOUNG, shear_modulus=SHEAR,
    )  # fmt: skip
    rod.shear_matrix[0, 0] *= shear_factor
    rod.shear_matrix[1, 1] *= shear_factor
    simulator.append(rod)
    simulator.constrain(rod).using(
        ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=np.array([0, 0, GRAVITY]))
    simulator.finalize()
    stepper = ea.PositionVerlet()
    now, steps = 0.0, round(simulated / dt)
    begin = time.perf_counter()
    with np.errstate(all="ignore"):
        for _ in range(steps):
            now = stepper.step(simulator, now, dt)
    seconds = time.perf_counter() - begin
    return TimedRun(rod.position_collection[:, -1] - [LENGTH, 0, 0], seconds, steps)


def largest_stable_step(elements: int) -> float:
    """Return PyElastica's largest step that survives 1 s, to 5 % of a wave's time per element."""
    crossing = LENGTH / elements / np.sqrt(YOUNG / DENSITY)
    for part in np.arange(1.2, 0.1, -0.05):
        tip = run_elastica(elements, float(part) * crossing).tip
        if np.isfinite(tip).all() and np.linalg.norm(tip) < LENGTH:
            return float(part) * crossing
    raise RuntimeError(f"PyElastica with {elements} elements was stable at no step tried")


def _scaling(sizes: list[int], repetitions: int) -> Figures:
    """Time steps in the plane and in space, first edge clamped inside as in the design's check."""
    figures: Figures = {}
    print("backward Euler, 5 ms, 1 s")
    for name, plane in (("planar", "xz"), ("3d", None)):
        seconds = []
        for nodes in sizes:
            rod = cantilever(nodes, plane=plane, clamp="inside")
            run = run_rod(rod, 5e-3, "backward_euler", repetitions)
            key = f"{name}_n{nodes}"
            figures[f"{key}_us_per_step"] = run.seconds / run.steps * 1e6
            figures[f"{key}_us_per_newton_iteration"] = run.seconds / run.iterations * 1e6
            figures[f"{key}_s_per_simulated_s"] = run.seconds
            if nodes == 21:
                figures[f"{key}_tip_z_mm"] = float(run.tip[2] * 1e3)
            seconds.append(run.seconds / run.iterations)
        # By least squares in the logarithms.
        growth = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
        figures[f"{name}_growth_exponent"] = float(growth)
    show(figures)
    return figures


def _peer(sizes: list[int], repetitions: int) -> Figures:
    """Release both, and measure each tip against its own program's limit of fine meshes."""
    run_elastica(4, 1e-4, 1e-3)  # compiles
    figures: Figures = {}
    coarse, fine = (run_rod(cantilever(n, plane="xz"), 1e-3, "midpoint").tip for n in (81, 161))
    rod_limit = _limit(coarse, fine, order=2)
    peers = {n: run_elastica(n - 1, largest_stable_step(n - 1)) for n in sizes}
    peer_limit = _limit(peers[sizes[-2]].tip, peers[sizes[-1]].tip, order=1)
    print("1 s of free fall, midpoint in space with 10 ms beside PyElastica at its largest step")
    for nodes, peer in peers.items():
        run = run_rod(cantilever(nodes, plane=None), 1e-2, "midpoint", repetitions)
        ours, theirs = f"3d_midpoint_10ms_n{nodes}", f"pyelastica_n{nodes}"
        figures[f"{theirs}_largest_stable_step_us"] = 1e6 / peer.steps
        figures[f"{theirs}_s_per_simulated_s"] = peer.seconds
        figures[f"{theirs}_error_mm"] = float(np.linalg.norm(peer.tip - peer_limit)) * 1e3
        figures[f"{ours}_s_per_simulated_s"] = run.seconds
        figures[f"{ours}_error_mm"] = float(np.linalg.norm(run.tip - rod_limit)) * 1e3
        figures[f"n{nodes}_times_faster_than_pyelastica"] = peer.seconds / run.seconds
    show(figures)
    return figures


def _limit(
    coarse: NDArray[np.float64], fine: NDArray[np.float64], order: int
) -> NDArray[np.float64]:
    """Return the limit of two meshes, the second twice as fine (Richardson)."""
    factor = 2.0**order
    return (factor * fine - coarse) / (factor - 1.0)


def run(quick: bool) -> Figures:
    """Measure and print; return every figure with its unit in the key."""
    sizes = [11, 21, 41] if quick else [11, 21, 41, 81, 161]
    repetitions = 10 if quick else 60
    return _scaling(sizes, repetitions) | _peer(sizes, repetitions)
