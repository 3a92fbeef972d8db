"""Draw the pictures of the planning page.

python3 scripts/draw_figures.py planning
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from der_planner.limb import Limb
from der_planner.model import ArcModel
from der_planner.planning import Motion, Plan, Workspace, plan
from figures.drawing import FOLDER, save

CASES = ("asynchronous", "same_direction", "opposite_direction")
COLORS = {
    ("der", "paper"): "tab:orange",
    ("der", "projected"): "tab:blue",
    ("der", "optimal"): "tab:green",
    ("pcc", "paper"): "tab:gray",
}


def every_plan(limb: Limb, case: str, period: float) -> dict[tuple[str, str], Plan]:
    """Return the plan of each model and method that has a colour."""
    motion = Motion.named(case, period=period, cycles=1)
    return {which: plan(limb, motion, *which) for which in COLORS}


def draw_methods(path: Path) -> None:
    """Paths, pressures and predicted errors of all methods, three cases at a period of 6 s."""
    figure, axes = plt.subplots(3, 3, figsize=(10, 8), layout="constrained")
    for row, case in zip(axes, CASES, strict=True):
        plans = every_plan(Limb.default(), case, 6.0)
        reference = next(iter(plans.values())).tip_reference * 100
        row[0].plot(*reference.T, "k--", lw=1, label="reference")
        for which, result in plans.items():
            color, name = COLORS[which], " ".join(which)
            row[0].plot(*(result.tip_predicted.T * 100), color=color, lw=1, label=name)
            for j, style in enumerate(("-", ":")):
                pressure = result.differential_pressure[:, j] / 1000
                row[1].plot(result.time, pressure, style, color=color, lw=1)
            row[2].semilogy(result.time, np.maximum(result.error * 1000, 1e-5), color=color, lw=1)
        row[0].set(xlabel="x [cm]", ylabel=f"{case}\ny [cm]", aspect="equal")
        row[1].set(xlabel="time [s]", ylabel="pressure [kPa]")
        row[2].set(xlabel="time [s]", ylabel="predicted error [mm]", ylim=(1e-4, 20))
    axes[0, 0].legend(fontsize=6)
    axes[0, 1].set_title("segment 0 solid, segment 1 dotted", fontsize=8)
    save(figure, path, 68)


def draw_branches(path: Path) -> None:
    """The tip's reach, its fold, and the two ways to one point."""
    limb = Limb.default()
    kinematics = ArcModel(limb)
    space = Workspace(kinematics)
    low, high = space.low, space.high
    figure, axes = plt.subplots(figsize=(5, 4.5), layout="constrained")
    grid = np.stack(
        np.meshgrid(*(np.linspace(a, b, 161) for a, b in zip(low, high, strict=True))), -1
    )
    tips = kinematics.tip(grid).reshape(-1, 2) * 100
    side = np.linalg.det(kinematics.tip_jacobians(grid)).ravel() > 0
    for sign, color, name in (
        (side, "tab:blue", "counter_clockwise"),
        (~side, "tab:red", "clockwise"),
    ):
        axes.plot(*tips[sign].T, ".", ms=1, color=color, alpha=0.15)
        axes.plot([], [], "o", color=color, label=name)
    point = kinematics.tip(np.radians([35.0, 20.0]))
    for found in space.solutions(point):
        color = "tab:blue" if found.branch == "counter_clockwise" else "tab:red"
        axes.plot(*(kinematics.curve(found.bend_angles).T * 100), color=color, lw=3)
    axes.plot(*(point * 100), "k*", ms=10)
    axes.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal")
    axes.legend(loc="lower left", fontsize=8)
    save(figure, path, 68)


def draw_limits(path: Path) -> None:
    """What a slew limit leaves of a fast motion: cut afterwards, or known to the optimisation."""
    limb = Limb.default()
    free = dataclasses.replace(
        limb, pneumatics=dataclasses.replace(limb.pneumatics, slew_limit=1e6)
    )
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    motion = Motion.named("opposite_direction", period=3.0, cycles=2)
    for robot, method, label, color in (
        (free, "optimal", "no slew limit", "0.7"),
        (limb, "projected", "projected, cut at 9 kPa/s", "tab:blue"),
        (limb, "optimal", "optimal, 9 kPa/s as a constraint", "tab:green"),
    ):
        result = plan(robot, motion, "der", method)
        axes[0].plot(result.time, result.differential_pressure[:, 0] / 1000, color=color, lw=1.2)
        axes[1].semilogy(
            result.time, np.maximum(result.error * 1000, 1e-3), color=color, lw=1.2, label=label
        )
    axes[0].set(xlabel="time [s]", ylabel="pressure of segment 0 [kPa]")
    axes[1].set(xlabel="time [s]", ylabel="predicted error [mm]")
    axes[1].legend(fontsize=7)
    save(figure, path, 68)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder for the pictures")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name, draw in (
        ("planning_methods", draw_methods),
        ("planning_branches", draw_branches),
        ("planning_limits", draw_limits),
    ):
        draw(options.out / f"{name}.png")
    return 0
