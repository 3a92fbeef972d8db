"""A silicone cantilever under its own weight, whose tips are known."""

import numpy as np

from der_planner.rod import Rod

RADIUS = 0.015
AREA = np.pi * RADIUS**2
INERTIA = np.pi * RADIUS**4 / 4
YOUNG = 1.5e6


def cantilever(nodes=21, clamp="inside", plane="xz", gravity=(0, 0, -9.81), **options) -> Rod:
    return Rod.uniform(
        length=0.25, nodes=nodes, EI=YOUNG * INERTIA, EA=YOUNG * AREA,
        GJ=YOUNG / 3 * 2 * INERTIA, mass_per_length=1240 * AREA, clamp=clamp, gravity=gravity,
        plane=plane, **options,
    )  # fmt: skip
