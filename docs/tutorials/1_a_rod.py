"""
A rod, beside the elastica and a vibrating beam
===============================================

The discrete elastic rod stands alone: no limb, no pressures, no ROS. Here it hangs under its own
weight, beside the exact elastica, and swings, beside the beam of Euler and Bernoulli.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import solve_bvp

from der_planner.rod import Rod

LENGTH, RADIUS, YOUNG, DENSITY, GRAVITY = 0.25, 0.015, 1.5e6, 1240.0, 9.81  # silicone, SI units
AREA, EI = np.pi * RADIUS**2, YOUNG * np.pi * RADIUS**4 / 4
MASS = DENSITY * AREA  # per length [kg/m]


def rod(gravity):
    """Return the rod, which is clamped at its first node and lies along x."""
    return Rod.uniform(
        length=LENGTH, nodes=41, EI=EI, EA=YOUNG * AREA, GJ=2 / 3 * EI, mass_per_length=MASS,
        gravity=(0, 0, -gravity), plane="xz",
    )  # fmt: skip


# %%
# At rest
# -------
# ``equilibrium`` finds the rest shape by Newton's method. The elastica's slope θ(s) obeys
# EI θ'' = w (L − s) cos θ with θ(0) = 0 and θ'(L) = 0, which scipy solves by collocation.

hanging = rod(GRAVITY)
shape = hanging.positions(hanging.equilibrium([]))

s = np.linspace(0, LENGTH, 201)
exact = solve_bvp(
    lambda s, y: [y[1], MASS * GRAVITY * (LENGTH - s) * np.cos(y[0]) / EI, np.cos(y[0]), np.sin(y[0])],
    lambda a, b: [a[0], b[1], a[2], a[3]],
    s, np.zeros((4, s.size)), tol=1e-9,
)  # fmt: skip

print(f"tip of the rod      {1e3 * shape[-1, 2]:.2f} mm")
print(f"tip of the elastica {1e3 * exact.y[3, -1]:.2f} mm")
assert abs(shape[-1, 2] - exact.y[3, -1]) < 2e-4

plt.plot(exact.y[2], exact.y[3], label="elastica")
plt.plot(shape[:, 0], shape[:, 2], "o", ms=4, label="rod, 41 nodes")
plt.axis("equal")
plt.xlabel("x [m]")
plt.ylabel("z [m]")
plt.legend()

# %%
# In motion
# ---------
# Released from straight under a hundredth of gravity, so that it swings a little, for two seconds in
# steps of 2 ms. The beam's first frequency is 1.8751² √(EI/m) / (2π L²).

light = rod(GRAVITY / 100)
step, count = 2e-3, 1000
motion = light.simulate(light.straight_state(), np.zeros((count, 0)), step)
tip = motion.positions[:, -1, 2]
time = step * np.arange(tip.size)

crossings = np.flatnonzero(np.diff(np.sign(tip - tip.mean())))
found = (crossings.size - 1) / 2 / (time[crossings[-1]] - time[crossings[0]])
beam = 1.8751**2 * np.sqrt(EI / MASS) / (2 * np.pi * LENGTH**2)
print(f"first frequency: rod {found:.3f} Hz, beam {beam:.3f} Hz")
assert abs(found / beam - 1) < 0.02

plt.figure()
plt.plot(time, 1e3 * tip)
plt.xlabel("time [s]")
plt.ylabel("tip [mm]")
plt.show()

# %%
# Longer steps stay stable, since the midpoint rule is implicit; exact derivatives come with the rod
# (``linearise_step``, ``stiffness``). More cases, tables of convergence and the derivation are on
# the pages *The rod alone* and *The rod*.
