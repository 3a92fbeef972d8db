"""Energy, force and stiffness are derivatives; time steps against known motions and orders."""

import numpy as np
import pytest
from differences import slopes
from scipy.spatial.transform import Rotation

from benchmarks.rod import YOUNG, cantilever, run_rod
from der_planner.limb import Limb
from der_planner.rod import Rod, RodState


@pytest.mark.parametrize("plane", ["xz", None])
def test_backward_euler_agrees_with_three_independent_codes(plane):
    shift = run_rod(cantilever(clamp="inside", plane=plane), 5e-3, "backward_euler").tip
    assert shift[2] == pytest.approx(-88.614e-3, abs=5e-7)
    assert shift[0] == pytest.approx(-19.353e-3, abs=5e-7)
    assert shift[1] == 0.0


def test_every_method_converges_to_the_known_limit():
    rod = cantilever(clamp="inside")
    assert run_rod(rod, 1e-4, "midpoint").tip[2] == pytest.approx(-112.78e-3, abs=1.5e-5)
    assert run_rod(rod, 2e-4, "sdirk2").tip[2] == pytest.approx(-112.78e-3, abs=2e-5)
    coarse, fine = (run_rod(rod, dt, "backward_euler").tip[2] for dt in (4e-4, 2e-4))
    assert 2 * fine - coarse == pytest.approx(-112.78e-3, abs=5e-4)


def test_torsional_frequencies():
    """A clamped-free shaft: f = (2n−1)/(4L) √(GJ/ρI), with the polar inertia of a solid circle."""
    rod = cantilever(81, plane=None, gravity=(0, 0, 0))
    twist = rod.free[rod.free % 4 == 3]
    stiffness = rod.stiffness(rod.straight_state())
    mass = rod.mass_diagonal[twist]
    scaled = stiffness[np.ix_(twist, twist)] / np.sqrt(np.outer(mass, mass))
    found = np.sqrt(np.linalg.eigvalsh(scaled)[:3]) / (2 * np.pi)
    speed = np.sqrt(YOUNG / 3 / 1240)
    np.testing.assert_allclose(found, np.array([1, 3, 5]) / (4 * 0.25) * speed, rtol=1e-3)


@pytest.mark.parametrize(
    ("method", "order"), [("midpoint", 2.0), ("sdirk2", 2.0), ("backward_euler", 1.0)]
)
@pytest.mark.parametrize("tau", [0.0, 0.01])
def test_order_in_the_time_step(method, order, tau):
    """Smooth motion in space (all modes resolved), with bending viscosity as well."""
    rod = Rod.uniform(
        length=0.2, nodes=6, EI=0.02, EA=20.0, GJ=0.02, mass_per_length=1.0, damping=0.3,
        gravity=(0, -2.0, -9.81), segments=[(0, 6)], moment_gain=[1e-5], material_damping=tau,
        rest_curvature=(1.0, 0.5),
    )  # fmt: skip
    start = rod.equilibrium([0.0])

    def end(dt):
        count = round(0.16 / dt)
        u = np.full((count, 1), 2e3)
        return rod.simulate(start, u, dt, method=method).final.q

    reference = end(1e-3 / 64)
    errors = [np.abs(end(dt) - reference).max() for dt in (0.5e-3, 0.25e-3)]
    measured = np.log2(errors[0] / errors[1])
    assert measured == pytest.approx(order, abs=0.2)


def total_energy(rod: Rod, q, v) -> float:
    kinetic = 0.5 * rod.mass_diagonal @ v**2
    return rod.energy(rod.state(q, v)) + kinetic - rod.external_force @ q


@pytest.mark.parametrize("plane", ["xz", None])
def test_energy_neither_grows_nor_drains_undamped(plane):
    rod = cantilever(11, plane=plane)
    start = rod.equilibrium([])
    push = np.zeros((11, 3))
    push[-1, 2] = -0.05
    start = rod.equilibrium([], start=start, forces=push)
    run = rod.simulate(start, np.zeros((2000, 0)), 1e-3, method="midpoint")
    base = total_energy(rod, rod.equilibrium([]).q, 0 * start.v)
    energy = np.array([total_energy(rod, q, v) - base for q, v in zip(run.q, run.v, strict=True)])
    assert energy[0] > 0
    early, late = energy[:500].mean(), energy[-500:].mean()
    assert late == pytest.approx(early, rel=2e-3)
    assert np.ptp(energy) < 0.02 * energy[0]


@pytest.mark.parametrize("option", [{"damping": 1.5}, {"material_damping": 0.02}])
def test_damping_drains_energy_and_ends_at_the_equilibrium(option):
    rod = cantilever(11, **option)
    run = rod.simulate(rod.straight_state(), np.zeros((4000, 0)), 5e-3)
    energy = [total_energy(rod, q, v) for q, v in zip(run.q[::50], run.v[::50], strict=True)]
    assert np.all(np.diff(energy) < 1e-9)
    np.testing.assert_allclose(run.tip[-1], rod.tip(rod.equilibrium([])), atol=1e-5)


@pytest.mark.parametrize("method", ["sdirk2", "midpoint", "backward_euler"])
@pytest.mark.parametrize("tau", [0.0, 0.02])
def test_a_planar_problem_moves_the_same_in_space(method, tau):
    limb = Limb.default()
    options = {
        "length": limb.length, "nodes": 21, "EI": 0.0175, "EA": 1380.0, "GJ": 0.0117,
        "mass_per_length": 1.066, "damping": 0.75, "segments": [(0, 10), (11, 10)],
        "moment_gain": [9.1e-6, 9.1e-6], "material_damping": tau, "gravity": (0.5, -1.0, 0.0),
    }  # fmt: skip
    planar, spatial = Rod.uniform(plane="xy", **options), Rod.uniform(**options)
    time = np.arange(80)[:, None] * 0.02
    u = 1e4 * np.sin(4 * time + [0.0, 1.0])
    a = planar.simulate(planar.straight_state(), u, 0.01, method=method)
    b = spatial.simulate(spatial.straight_state(), u, 0.01, method=method)
    assert np.abs(a.tip[:, 1]).max() > 0.03
    np.testing.assert_allclose(a.q, b.q, atol=2e-10)
    np.testing.assert_allclose(a.v, b.v, atol=2e-7)


COMMON = {"length": 0.2, "nodes": 7, "EI": 0.02, "EA": 60.0, "GJ": 0.013, "mass_per_length": 1.0}


def bent_state(rod: Rod, seed: int, size: float = 0.012) -> RodState:
    """A random configuration, reached in small moves so that no frame jumps, re-based there."""
    random = np.random.default_rng(seed)
    target = rod.straight_state().q + random.normal(size=4 * rod.nodes - 1) * size
    target[3::4] = random.normal(size=rod.nodes - 1)
    if rod.plane is not None:
        off_plane = 2 if rod.plane == "xy" else 1
        target[off_plane::4] = 0.0
        target[3::4] = 0.0
    if rod.mesh.ghost:
        target[:3] = 0.0
    return rod.state(target)


def by_differences(function, state: RodState, rod: Rod):
    """Derivatives by what is free; the frames are transported from the state, re-based there."""

    def at(free):
        q = state.q.copy()
        q[rod.free] = free
        return function(rod.state(q, like=state))

    return slopes(at, state.q[rod.free])


RODS = [
    pytest.param({"clamp": "ghost", "rest_curvature": (3.0, -2.0), "rest_twist": 4.0}, id="ghost"),
    pytest.param({"clamp": "inside"}, id="inside"),
    pytest.param({"clamp": "free", "rest_curvature": (0.0, 5.0)}, id="free"),
    pytest.param({"clamp": "ghost", "plane": "xy", "rest_curvature": (4.0, 0.0)}, id="planar xy"),
    pytest.param({"clamp": "free", "plane": "xz", "rest_curvature": (0.0, 4.0)}, id="planar xz"),
]


@pytest.mark.parametrize("options", RODS)
@pytest.mark.parametrize("seed", [1, 2])
def test_force_is_minus_the_gradient_of_the_energy(options, seed):
    rod = Rod.uniform(**COMMON, **options)
    state = bent_state(rod, seed)
    gradient = by_differences(rod.energy, state, rod)
    force = rod.internal_force(state)[rod.free]
    assert np.abs(force).max() > 1.0
    np.testing.assert_allclose(force, -gradient, atol=1e-7 * np.abs(force).max())


@pytest.mark.parametrize("options", RODS)
def test_stiffness_is_the_symmetric_hessian_of_the_energy(options):
    rod = Rod.uniform(**COMMON, **options)
    state = bent_state(rod, 3)
    hessian = rod.stiffness(state)[np.ix_(rod.free, rod.free)]
    np.testing.assert_array_equal(hessian, hessian.T)
    jacobian = by_differences(lambda s: -rod.internal_force(s)[rod.free], state, rod)
    # Under parallel transport the force is no gradient in a chart: its derivative has an
    # antisymmetric part (the transport's curvature times the twisting torque), and the Hessian is
    # the symmetric part.
    symmetric = 0.5 * (jacobian + jacobian.T)
    np.testing.assert_allclose(hessian, symmetric, atol=1e-7 * np.abs(hessian).max())


def test_rigid_motion_leaves_the_energy_and_turns_the_forces():
    rod = Rod.uniform(**COMMON, clamp="free", rest_curvature=(3.0, -2.0), rest_twist=4.0)
    state = bent_state(rod, 6)
    turn = Rotation.from_rotvec([0.5, -1.0, 0.25]).as_matrix()
    q = state.q.copy()
    moved = state.positions @ turn.T + [0.3, -0.1, 0.2]
    for axis in range(3):
        q[axis::4] = moved[:, axis]
    turned = RodState(q, state.v, state.directors @ turn.T, state.reference_twist)
    assert rod.energy(turned) == pytest.approx(rod.energy(state), rel=1e-12)
    force, turned_force = rod.internal_force(state), rod.internal_force(turned)
    np.testing.assert_allclose(turned_force[3::4], force[3::4], atol=1e-11)
    before = np.stack([force[axis::4] for axis in range(3)], axis=1)
    after = np.stack([turned_force[axis::4] for axis in range(3)], axis=1)
    np.testing.assert_allclose(after, before @ turn.T, atol=1e-10)
