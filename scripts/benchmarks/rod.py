"""The rod's kernels beside PyElastica, on the cantilever that is released under its weight."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from der_planner.rod import Rod

LENGTH, RADIUS, YOUNG, DENSITY, GRAVITY = 0.25, 0.015, 1.5e6, 1240.0, -9.81
AREA = np.pi * RADIUS**2
INERTIA = 0.25 * np.pi * RADIUS**4
SHEAR = YOUNG / 3.0


@dataclass(frozen=True)
class TimedRun:
    """One timed simulation.

    Attributes:
        tip: (3,) displacement of the tip at the end [m].
        seconds: wall time. simulated: simulated time [s]. steps: time steps. iterations: Newton's.
    """

    tip: NDArray[np.float64]
    seconds: float
    simulated: float
    steps: int
    iterations: int = 0

    @property
    def per_simulated_second(self) -> float:
        """Wall seconds per simulated second."""
        return self.seconds / self.simulated


def cantilever(nodes: int, *, plane: str | None, clamp: str = "ghost", stretch: float = 1.0) -> Rod:
    """Return the cantilever of the design's check values, its EA times `stretch`."""
    return Rod.uniform(
        length=LENGTH, nodes=nodes, EI=YOUNG * INERTIA, EA=stretch * YOUNG * AREA,
        GJ=SHEAR * 2 * INERTIA, mass_per_length=DENSITY * AREA, clamp=clamp,
        gravity=(0, 0, GRAVITY), plane=plane,
    )  # fmt: skip


def run_rod(rod: Rod, dt: float, method: str, simulated: float, repetitions: int = 1) -> TimedRun:
    """Release the cantilever; the best wall time of several repetitions."""
    start = rod.straight_state()
    still = np.zeros((round(simulated / dt), rod.segment_count))
    best = np.inf
    for _ in range(repetitions):
        begin = time.perf_counter()
        motion = rod.simulate(start, still, dt, method=method)
        best = min(best, time.perf_counter() - begin)
    return TimedRun(
        motion.tip[-1] - motion.tip[0], best, simulated, len(still), motion.newton_iterations
    )


def run_elastica(
    elements: int, dt: float, simulated: float, *, shear_factor: float = 1.0
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
    return TimedRun(rod.position_collection[:, -1] - [LENGTH, 0, 0], seconds, simulated, steps)


def largest_stable_step(elements: int) -> float:
    """Return PyElastica's largest step that survives 1 s, to 5 % of a wave's time per element."""
    crossing = LENGTH / elements / np.sqrt(YOUNG / DENSITY)
    for part in np.arange(1.2, 0.1, -0.05):
        tip = run_elastica(elements, float(part) * crossing, 1.0).tip
        if np.isfinite(tip).all() and np.linalg.norm(tip) < LENGTH:
            return float(part) * crossing
    raise RuntimeError(f"PyElastica with {elements} elements was stable at no step tried")


def _scaling(figures: dict[str, float | str], sizes: list[int], repetitions: int) -> None:
    print("backward Euler, 5 ms, 1 s (first edge clamped inside, as in the design's check)")
    print("     N   planar us/step  us/iteration    3D us/step  us/iteration")
    for name, plane in (("planar", "xz"), ("3d", None)):
        seconds = []
        for nodes in sizes:
            rod = cantilever(nodes, plane=plane, clamp="inside")
            run = run_rod(rod, 5e-3, "backward_euler", 1.0, repetitions)
            key = f"{name}_n{nodes}"
            figures[f"{key}_us_per_step"] = run.seconds / run.steps * 1e6
            figures[f"{key}_us_per_newton_iteration"] = run.seconds / run.iterations * 1e6
            figures[f"{key}_s_per_simulated_s"] = run.per_simulated_second
            if nodes == 21:
                figures[f"{key}_tip_z_mm"] = float(run.tip[2] * 1e3)
            seconds.append(run.seconds / run.iterations)
        # By least squares in the logarithms.
        growth = np.polyfit(np.log(sizes), np.log(seconds), 1)[0]
        figures[f"{name}_growth_exponent"] = float(growth)
    for nodes in sizes:
        row = [
            figures[f"{name}_n{nodes}_us_per_{unit}"]
            for name in ("planar", "3d")
            for unit in ("step", "newton_iteration")
        ]
        print(f"  {nodes:4d} {row[0]:13.2f} {row[1]:13.2f} {row[2]:15.2f} {row[3]:13.2f}")
    print(
        f"  growth exponent of an iteration with N: "
        f"planar {figures['planar_growth_exponent']:.2f}, "
        f"3D {figures['3d_growth_exponent']:.2f}"
    )


def _peer(figures: dict[str, float | str], sizes: list[int], repetitions: int) -> None:
    """Both at 1 s, each against its own limit of fine meshes."""
    run_elastica(4, 1e-4, 1e-3)  # compiles
    fine = sizes[-1]
    rod_limit = _limit([run_rod(cantilever(n, plane="xz"), 1e-3, "midpoint", 1.0).tip
                        for n in (81, 161)], order=2)  # fmt: skip
    peer_runs = {n: run_elastica(n - 1, largest_stable_step(n - 1), 1.0) for n in sizes}
    coarse = sizes[-2]
    peer_limit = _limit([peer_runs[coarse].tip, peer_runs[fine].tip], order=1)
    print("1 s of free fall; error of the tip against each program's own limit of fine meshes")
    print("     N  PyElastica dt us   s per s  error mm |  3D midpoint 10 ms s per s  error mm"
          "   times faster")  # fmt: skip
    for nodes in sizes:
        run = run_rod(cantilever(nodes, plane=None), 1e-2, "midpoint", 1.0, repetitions)
        peer = peer_runs[nodes]
        error = float(np.linalg.norm(run.tip - rod_limit)) * 1e3
        peer_error = float(np.linalg.norm(peer.tip - peer_limit)) * 1e3
        faster = peer.per_simulated_second / run.per_simulated_second
        key = f"n{nodes}"
        figures[f"pyelastica_{key}_largest_stable_step_us"] = 1e6 / peer.steps
        figures[f"pyelastica_{key}_s_per_simulated_s"] = peer.per_simulated_second
        figures[f"pyelastica_{key}_us_per_step"] = peer.seconds / peer.steps * 1e6
        figures[f"pyelastica_{key}_error_mm"] = peer_error
        figures[f"3d_midpoint_10ms_{key}_s_per_simulated_s"] = run.per_simulated_second
        figures[f"3d_midpoint_10ms_{key}_error_mm"] = error
        figures[f"{key}_times_faster_than_pyelastica"] = faster
        print(
            f"  {nodes:4d} {1e6 / peer.steps:15.1f} {peer.per_simulated_second:10.4f} "
            f"{peer_error:9.3f} | {run.per_simulated_second:20.5f} {error:13.3f} {faster:12.0f}"
        )


def _limit(tips: list[NDArray[np.float64]], order: int) -> NDArray[np.float64]:
    """Return the limit of two meshes, the second twice as fine (Richardson)."""
    factor = 2.0**order
    return (factor * tips[1] - tips[0]) / (factor - 1.0)


def run(quick: bool) -> dict[str, float | str]:
    """Measure and print; return every figure with its unit in the key."""
    figures: dict[str, float | str] = {}
    sizes = [11, 21, 41] if quick else [11, 21, 41, 81, 161]
    repetitions = 10 if quick else 60
    _scaling(figures, sizes, repetitions)
    _peer(figures, sizes, repetitions)
    return figures
