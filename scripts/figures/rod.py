"""Draw the checks of the rod that docs/guide/rod.md shows.

python3 scripts/draw_figures.py rod [FOLDER]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from benchmarks.rod import AREA, YOUNG, cantilever, run_elastica
from der_planner.limb import Limb
from der_planner.rod import Rod
from figures.drawing import FOLDER, save

ELASTICA_TIP_MM = 66.3753  # exact inextensible elastica: examples/cantilever.py


def statics(folder: Path) -> None:
    """Elastica and circle."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4))
    rod = cantilever()
    shape = rod.positions(rod.equilibrium([])) * 1e3
    axes[0].plot(shape[:, 0], shape[:, 2], ".-")
    axes[0].set(title="cantilever under its weight", xlabel="x [mm]", ylabel="z [mm]")
    axes[0].set_aspect("equal")
    sizes = np.array([11, 21, 41, 81, 161])
    for clamp in ("ghost", "inside"):
        tips = []
        for n in sizes:
            stiff = cantilever(int(n), clamp, EA=1e4 * YOUNG * AREA)
            tips.append(-1e3 * stiff.tip(stiff.equilibrium([]))[2])
        axes[1].loglog(sizes, np.abs(np.array(tips) / ELASTICA_TIP_MM - 1) * 100, "o-", label=clamp)
    axes[1].set(title="static tip against the elastica", xlabel="nodes", ylabel="error [%]")
    axes[1].legend(title="clamp")
    for turns in (0.25, 0.5, 1.0, 2.0):
        rolled = Rod.uniform(
            length=0.25, nodes=41, EI=0.02, EA=1000.0, GJ=0.02, mass_per_length=1.0,
            segments=[(0, 41)], moment_gain=[1.0], plane="xy",
        )  # fmt: skip
        x = rolled.positions(rolled.equilibrium([2 * np.pi * turns * 0.02 / 0.25])) * 1e3
        axes[2].plot(x[:, 0], x[:, 1], label=f"{turns:g}")
    axes[2].set(title="end moment: turns to a circle", xlabel="x [mm]", ylabel="y [mm]")
    axes[2].set_aspect("equal")
    axes[2].legend()
    figure.tight_layout()
    save(figure, folder / "rod_statics.png", 80)


def dynamics(folder: Path) -> None:
    """Release of the cantilever, orders, energy."""
    figure, axes = plt.subplots(1, 3, figsize=(14, 3.8))
    rod = cantilever(clamp="inside")
    start = rod.straight_state()
    for method, dt in (("backward_euler", 5e-3), ("midpoint", 1e-2), ("sdirk2", 1e-2)):
        run = rod.simulate(start, np.zeros((round(1 / dt), 0)), dt, method=method)
        axes[0].plot(run.time, run.tip[:, 2] * 1e3, label=f"{method}, {dt * 1e3:g} ms")
    peer = [
        run_elastica(20, 1.2e-4, t, shear_factor=3.0).tip[2] * 1e3
        for t in np.arange(0.1, 1.01, 0.1)
    ]
    axes[0].plot(np.arange(0.1, 1.01, 0.1), peer, "k+", label="PyElastica, 20 elements")
    axes[0].set(title="tip after release", xlabel="time [s]", ylabel="z [mm]")
    axes[0].legend()
    limit = rod.simulate(start, np.zeros((20000, 0)), 5e-5, method="midpoint").tip[-1]
    steps = np.array([1e-2, 5e-3, 2e-3, 1e-3, 5e-4])
    for method in ("backward_euler", "midpoint", "sdirk2"):
        errors = [
            np.linalg.norm(
                rod.simulate(start, np.zeros((round(1 / dt), 0)), dt, method=method).tip[-1] - limit
            )
            for dt in steps
        ]
        axes[1].loglog(steps * 1e3, np.array(errors) * 1e3, "o-", label=method)
    axes[1].set(title="error of the tip at 1 s", xlabel="step [ms]", ylabel="[mm]")
    axes[1].legend()
    gentle = cantilever(11)
    push = np.zeros((11, 3))
    push[-1, 2] = -0.05
    base = gentle.equilibrium([], forces=push)
    rest = gentle.equilibrium([])

    def energy(q: np.ndarray, v: np.ndarray) -> float:
        kinetic = 0.5 * gentle.mass_diagonal @ v**2
        return gentle.energy(gentle.state(q)) + float(kinetic - gentle.external_force @ q)

    zero = energy(rest.q, rest.v)
    for method, dt in (("midpoint", 1e-3), ("sdirk2", 1e-3), ("backward_euler", 1e-3)):
        run = gentle.simulate(base, np.zeros((2000, 0)), dt, method=method)
        values = [energy(q, v) - zero for q, v in zip(run.q[::20], run.v[::20], strict=True)]
        axes[2].plot(run.time[::20], np.array(values) / values[0], label=method)
    axes[2].set(title="energy, undamped, 1 ms steps", xlabel="time [s]", ylabel="of the start")
    axes[2].legend()
    figure.tight_layout()
    save(figure, folder / "rod_dynamics.png", 80)


def stability(folder: Path) -> None:
    """Why the midpoint rule is not the default."""
    limb = Limb.default()
    rod = Rod.from_limb(limb)
    time = np.arange(60) * 0.05
    u = 15e3 * np.sin(2 * np.pi * time[:, None] / 3 + [0.0, 1.0])
    figure, axis = plt.subplots(figsize=(7, 3.6))
    for method in ("midpoint", "sdirk2"):
        run = rod.simulate(rod.straight_state(), u[:17], 0.05, substeps=4, method=method)
        axis.plot(run.time, np.linalg.norm(run.v[:, -3:], axis=1), ".-", label=method)
    fine = rod.simulate(rod.straight_state(), u[:17], 0.05, substeps=400, method="sdirk2")
    axis.plot(fine.time, np.linalg.norm(fine.v[:, -3:], axis=1), "k:", label="0.125 ms steps")
    axis.set(title="default limb, 12.5 ms steps", xlabel="time [s]", ylabel="tip speed [m/s]")
    axis.set_yscale("log")
    axis.legend()
    figure.tight_layout()
    save(figure, folder / "rod_stability.png", 80)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", nargs="?", type=Path, default=FOLDER)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for draw in (statics, dynamics, stability):
        draw(folder)
    return 0
