"""An independent program, PyElastica, on the same cantilever."""

import numpy as np
import pytest

from der_planner.rod import Rod

pytestmark = pytest.mark.slow

elastica = pytest.importorskip("elastica")

LENGTH, RADIUS, YOUNG, DENSITY, GRAVITY = 0.25, 0.015, 1.5e6, 1240.0, -9.81
AREA = np.pi * RADIUS**2
INERTIA = 0.25 * np.pi * RADIUS**4
TIME = 0.2


class Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):
    """A rod with a clamp under gravity."""


def fall_of_elastica(elements: int, shear_factor: float) -> np.ndarray:
    simulator = Simulator()
    rod = elastica.CosseratRod.straight_rod(
        elements, np.zeros(3), np.array([1.0, 0, 0]), np.array([0, 0, 1.0]), LENGTH, RADIUS,
        DENSITY, youngs_modulus=YOUNG, shear_modulus=YOUNG / 3,
    )  # fmt: skip
    rod.shear_matrix[0, 0] *= shear_factor
    rod.shear_matrix[1, 1] *= shear_factor
    simulator.append(rod)
    simulator.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    simulator.add_forcing_to(rod).using(
        elastica.GravityForces, acc_gravity=np.array([0, 0, GRAVITY])
    )
    simulator.finalize()
    crossing = LENGTH / elements / np.sqrt(YOUNG / DENSITY)
    dt = 0.55 * crossing / np.sqrt(max(1.0, shear_factor / 1.2))
    steps = int(np.ceil(TIME / dt))
    stepper, now = elastica.PositionVerlet(), 0.0
    for _ in range(steps):
        now = stepper.step(simulator, now, TIME / steps)
    return rod.position_collection[:, -1] - [LENGTH, 0, 0]


def fall_of_the_rod(nodes: int) -> np.ndarray:
    rod = Rod.uniform(
        length=LENGTH, nodes=nodes, EI=YOUNG * INERTIA, EA=YOUNG * AREA, GJ=YOUNG / 3 * 2 * INERTIA,
        mass_per_length=DENSITY * AREA, clamp="inside", gravity=(0, 0, GRAVITY),
    )  # fmt: skip
    run = rod.simulate(rod.straight_state(), np.zeros((400, 0)), TIME / 400, method="midpoint")
    return run.tip[-1] - run.tip[0]


def test_both_fall_alike_and_more_so_on_finer_meshes():
    """PyElastica holds its first element, as the inside clamp does; its shear is suppressed."""
    gaps = []
    for elements in (10, 20, 40):
        peer = fall_of_elastica(elements, shear_factor=10.0)
        own = fall_of_the_rod(elements + 1)
        assert own[2] < -0.08
        gaps.append(np.linalg.norm(own - peer) / np.linalg.norm(peer))
    assert gaps[0] > 1.7 * gaps[1] > 2.8 * gaps[2]
    assert gaps[2] < 0.003
