"""Equilibria against what is known of elastic rods."""

import numpy as np
import pytest
from cantilever import cantilever

from der_planner.rod import ConvergenceError, Rod


@pytest.mark.parametrize("plane", ["xy", None])
@pytest.mark.parametrize("turns", [1.0, 2.0])
def test_an_end_moment_rolls_the_rod_to_a_circle(plane, turns):
    nodes = 41
    rod = Rod.uniform(
        length=0.25, nodes=nodes, EI=0.02, EA=1000.0, GJ=0.02, mass_per_length=1.0,
        segments=[(0, nodes)], moment_gain=[1.0], plane=plane,
    )  # fmt: skip
    step = rod.rest_lengths[0]
    turn = 2 * np.pi * turns / (nodes - 2)
    moment = 0.02 / step * 2 * np.tan(turn / 2) * (1 + np.tan(turn / 2) ** 2)
    state = rod.equilibrium([moment / step / rod.input_gain[0]])
    edges = np.diff(state.positions @ [1.0, 1j, 0.0])
    np.testing.assert_allclose(np.angle(edges[1:] / edges[:-1]), turn, atol=1e-9)
    # The continuum's angle G u L / EI differs by the second order in the turning of a node
    continuum = moment * (nodes - 2) * step / 0.02
    assert continuum == pytest.approx(2 * np.pi * turns, rel=turn**2)


def test_a_rod_curved_and_twisted_at_rest_is_a_helix():
    curvature, twist, length = 10.0, 15.0, 0.5
    error = []
    for nodes in (41, 81):
        state = None
        for part in np.linspace(0.1, 1.0, 10):
            rod = Rod.uniform(
                length=length, nodes=nodes, EI=0.02, EA=1000.0, GJ=0.02, mass_per_length=1.0,
                rest_curvature=(0.0, part * curvature), rest_twist=part * twist,
            )  # fmt: skip
            state = rod.equilibrium([], start=state)
        assert rod.energy(state) < 1e-20
        error.append(np.abs(state.positions - helix(curvature, twist, length, nodes)).max())
    assert error[0] < 0.01 * length
    assert np.log2(error[0] / error[1]) > 1.8


def helix(curvature, torsion, length, nodes):
    """Points of the helix that starts at the origin along x and curves toward z (Frenet)."""
    s = np.linspace(0, length, nodes)[:, None]
    rate = np.hypot(curvature, torsion)
    tangent, normal = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    axis = (torsion * tangent + curvature * np.cross(tangent, normal)) / rate
    along = axis * (axis @ tangent)
    across = tangent - along
    aside = np.cross(axis, tangent)
    return along * s + across * np.sin(rate * s) / rate + aside * (1 - np.cos(rate * s)) / rate


def test_load_stepping_reaches_what_newton_alone_does_not():
    rod = cantilever(clamp="ghost")
    heavy = np.zeros((21, 3))
    heavy[:, 2] = -40 * rod.mass_diagonal[0::4]
    heavy[-1, 0] = -3.0
    state = rod.equilibrium([], forces=heavy)
    balance = rod.internal_force(state) + rod.external_force
    for axis in range(3):
        balance[axis::4] += heavy[:, axis]
    np.testing.assert_allclose(balance[rod.free], 0.0, atol=1e-8)


def test_no_equilibrium_raises_with_the_step_and_the_last_state():
    rod = Rod.uniform(length=0.25, nodes=11, EI=0.02, EA=10.0, GJ=0.02, mass_per_length=1.0)
    # beyond this the rod is pulled apart or pushed through itself: no stable answer near
    force = np.zeros((11, 3))
    force[-1, 0] = -1e6
    with pytest.raises(ConvergenceError, match="no equilibrium beyond") as caught:
        rod.equilibrium([], forces=force)
    assert caught.value.iterations > 0
    assert np.isfinite(caught.value.state.q).all()
