"""A cantilever that hangs under its own weight, beside the exact elastica.

A rod of silicone rubber, 0.25 m long and 30 mm thick, is clamped at one end and sags until it
rests. The inextensible elastica under its weight w per length satisfies

    EI θ'' = −w (L − s) cos θ,    θ(0) = 0,  θ'(L) = 0

for the slope θ below the horizontal at arc length s, here solved by collocation (scipy).

    python3 src/der_planner/examples/cantilever.py
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from der_planner.rod import Rod

LENGTH, RADIUS, YOUNG, DENSITY, GRAVITY = 0.25, 0.015, 1.5e6, 1240.0, 9.81
AREA = np.pi * RADIUS**2
EI = YOUNG * np.pi * RADIUS**4 / 4
WEIGHT = DENSITY * AREA * GRAVITY


def elastica_tip() -> float:
    """Return the height of the exact elastica's tip [m]."""

    def slope(s: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        angle, curvature, _ = y
        return np.stack([curvature, -WEIGHT * (LENGTH - s) * np.cos(angle) / EI, -np.sin(angle)])

    def ends(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([a[0], b[1], a[2]])

    s = np.linspace(0.0, LENGTH, 201)
    solution = solve_bvp(slope, ends, s, np.zeros((3, len(s))), tol=1e-10)
    return float(solution.y[2, -1])


def rod_tip(nodes: int, clamp: Literal["ghost", "inside"]) -> float:
    """Return the height of the discrete rod's tip at rest [m]."""
    rod = Rod.uniform(
        length=LENGTH, nodes=nodes, EI=EI, EA=1e3 * YOUNG * AREA, GJ=2 / 3 * EI,
        mass_per_length=DENSITY * AREA, gravity=(0, 0, -GRAVITY), plane="xz", clamp=clamp,
    )  # fmt: skip
    return float(rod.tip(rod.equilibrium([]))[2])


def main() -> None:
    """Print the tip for finer and finer rods, with both clamps."""
    exact = elastica_tip()
    print(f"exact elastica: tip {1e3 * exact:.3f} mm")
    print("nodes   ghost edge [mm]   error     first edge held [mm]   error")
    for nodes in (11, 21, 41, 81):
        ghost, inside = rod_tip(nodes, "ghost"), rod_tip(nodes, "inside")
        print(
            f"{nodes:5d}   {1e3 * ghost:15.3f}   {ghost / exact - 1:+.3%}   "
            f"{1e3 * inside:20.3f}   {inside / exact - 1:+.3%}"
        )


if __name__ == "__main__":
    main()
