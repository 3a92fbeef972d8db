"""Equilibria against what is known of elastic rods: couples of segments, weight, carried masses."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import solve_bvp

from benchmarks.rod import cantilever
from der_planner.limb import GRAVITY, Limb
from der_planner.model.bending import PolylineKinematics, bend_angles
from der_planner.rod import ConvergenceError, Rod


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
    rod = cantilever()
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


EI = 0.02


def segment_rod(nodes: int = 12, segments=((0, 12),), plane=None) -> Rod:
    return Rod.uniform(
        length=0.24, nodes=nodes, EI=EI, EA=1000.0, GJ=0.015, mass_per_length=1.0, clamp="free",
        segments=segments, moment_gain=np.full(len(segments), 1e-5), plane=plane,
    )  # fmt: skip


def node_forces(force):
    return np.stack([force[axis::4] for axis in range(3)], axis=1)


@pytest.mark.parametrize("turn", [0.02, 0.1, -0.3, 0.6])
@pytest.mark.parametrize("plane", [None, "xy"])
def test_bending_forces_of_an_even_bend_are_two_couples(turn, plane):
    """Theorem 1: nothing inside, and |F| = 4 EI sinθ / (l ē (1 + cosθ)²) at the four end nodes."""
    rod = segment_rod(plane=plane)
    q = PolylineKinematics(rod).configuration([turn * 10])
    forces = node_forces(rod.internal_force(q))
    step = rod.rest_lengths[0]
    magnitude = 4 * EI * abs(np.sin(turn)) / (step * step * (1 + np.cos(turn)) ** 2)
    np.testing.assert_allclose(forces[2:-2], 0.0, atol=1e-10 * magnitude)
    np.testing.assert_allclose(
        np.linalg.norm(forces[[0, 1, -2, -1]], axis=1), magnitude, rtol=1e-10
    )


def test_input_matrix_is_the_direction_against_bending():
    """Corollary 1: each segment's unit couples are −F_b/|F_b|, the connector carries nothing."""
    rod = segment_rod(segments=((0, 6), (6, 6)))
    q = PolylineKinematics(rod).configuration([0.5, 0.8])
    forces = node_forces(rod.internal_force(q))
    matrix = rod.input_matrix(q) / rod.input_gain
    for index, (first, count) in enumerate(rod.segments):
        column = node_forces(matrix[:, index])
        inside = slice(first, first + count)
        ends = [first, first + 1, first + count - 2, first + count - 1]
        direction = forces[ends] / np.linalg.norm(forces[ends], axis=1)[:, None]
        np.testing.assert_allclose(column[ends], -direction, atol=1e-9)
        outside = np.ones(12, dtype=bool)
        outside[ends] = False
        np.testing.assert_array_equal(column[outside], 0.0)
        # a couple: no net force, no net moment of the two together
        np.testing.assert_allclose(column.sum(axis=0), 0.0, atol=1e-14)
        moment = np.cross(rod.positions(q)[inside], column[inside]).sum(axis=0)
        np.testing.assert_allclose(moment, 0.0, atol=1e-14)
    assert not matrix[3::4].any()


def test_pressure_bends_as_the_continuum_does():
    """The couples span N_j − 2 edges, the gain makes up for it: angle = G u L / EI if small."""
    for count in (5, 9, 20):
        rod = segment_rod(nodes=count, segments=((0, count),), plane="xy")
        clamped = Rod(dataclasses.replace(rod.mesh, clamped=np.arange(7)), "xy")
        pressure = 100.0
        angle = bend_angles(clamped, clamped.equilibrium([pressure]).q)
        assert angle[0] == pytest.approx(1e-5 * pressure * 0.24 / EI, rel=1e-4)


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
