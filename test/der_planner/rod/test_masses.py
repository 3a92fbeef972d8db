"""Gravity and carried masses on the rod, against integrals and closed forms."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from der_planner.limb import GRAVITY, Limb
from der_planner.rod import Rod

BEAM = {"length": 0.25, "EI": 0.02, "EA": 2e4, "GJ": 0.013, "mass_per_length": 0.8}


def rod_of(nodes=81, *, plane="xy", **changes):
    return Rod.uniform(nodes=nodes, plane=plane, **(BEAM | changes))


@pytest.mark.parametrize("arc_length", [0.05, 0.1, 0.1337, 0.18, 0.2459, 0.254])
def test_a_mass_keeps_its_weight_and_its_moment(arc_length):
    limb = Limb.default()
    limb = limb.mounted("sideways").carrying(0.3, at=0.0)
    bare = Rod.from_limb(limb)
    rod = Rod.from_limb(limb.carrying(0.04, at=min(arc_length, limb.length)))
    added = rod.mesh.node_mass - bare.mesh.node_mass
    x = rod.positions(rod.straight_state())[:, 0]
    assert added.min() >= 0
    assert added.sum() == pytest.approx(0.04, rel=1e-12)
    assert added @ x == pytest.approx(0.04 * min(arc_length, limb.length), rel=1e-12)
    swung = rod.mass_diagonal[1::4] - bare.mass_diagonal[1::4]
    np.testing.assert_allclose(swung, added, atol=1e-15)
    force = rod.external_force[1::4] - bare.external_force[1::4]
    assert force.sum() == pytest.approx(-0.04 * GRAVITY, rel=1e-12)


def elastica(tip_mass, gravity):
    """Tip of the heavy elastica with an end mass: EI ψ'' = −n × t, n the force beyond s."""
    length, density = BEAM["length"], BEAM["mass_per_length"]

    def slopes(s, y, pull):
        beyond = density * (length - s) + tip_mass
        fx, fy = beyond * pull[0], beyond * pull[1]
        moment = np.cos(y[0]) * fy - np.sin(y[0]) * fx
        return np.stack([y[1], -moment / BEAM["EI"], np.cos(y[0]), np.sin(y[0])])

    grid = np.linspace(0.0, length, 200)
    guess = np.zeros((4, grid.size))
    for share in np.linspace(0.1, 1.0, 10):
        solved = solve_bvp(
            lambda s, y, pull=share * gravity: slopes(s, y, pull),
            lambda a, b: np.array([a[0], b[1], a[2], a[3]]),
            grid, guess, tol=1e-9, max_nodes=20000,
        )  # fmt: skip
        assert solved.success
        grid, guess = solved.x, solved.y
    return solved.y[2:, -1]


@pytest.mark.parametrize("plane", ["xy", None])
@pytest.mark.parametrize("gravity", [(0.0, -9.81, 0.0), (6.0, 7.0, 0.0), (-2.0, -3.0, 0.0)])
def test_rest_under_weight_and_tip_mass_is_the_heavy_elastica(gravity, plane):
    rod = rod_of(gravity=gravity, masses=[(0.25, 0.05)], plane=plane)
    tip = rod.tip(rod.equilibrium([]))[:2]
    exact = elastica(0.05, np.array(gravity[:2]))
    assert np.hypot(*(exact - [0.25, 0.0])) > 0.03
    np.testing.assert_allclose(tip, exact, atol=1.5e-4)
