"""Energy, force and stiffness: derivatives, symmetry, rigid motions, momentum."""

import numpy as np
import pytest

from der_planner.rod import Rod, RodState

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


def by_differences(function, state: RodState, rod: Rod, indices, step: float = 1e-6):
    columns = []
    for d in indices:
        change = np.zeros_like(state.q)
        change[d] = step
        # the frames of the moved states are transported from `state`: re-based where we test
        ahead = rod.state(state.q + change, like=state)
        behind = rod.state(state.q - change, like=state)
        columns.append((function(ahead) - function(behind)) / (2 * step))
    return np.array(columns)


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
    gradient = by_differences(rod.energy, state, rod, rod.free)
    force = rod.internal_force(state)[rod.free]
    assert np.abs(force).max() > 1.0
    np.testing.assert_allclose(force, -gradient, atol=1e-7 * np.abs(force).max())


@pytest.mark.parametrize("options", RODS)
def test_stiffness_is_the_symmetric_hessian_of_the_energy(options):
    rod = Rod.uniform(**COMMON, **options)
    state = bent_state(rod, 3)
    hessian = rod.stiffness(state)[np.ix_(rod.free, rod.free)]
    np.testing.assert_array_equal(hessian, hessian.T)
    jacobian = by_differences(lambda s: -rod.internal_force(s)[rod.free], state, rod, rod.free)
    # Under parallel transport the force is no gradient in a chart: its derivative has an
    # antisymmetric part (the transport's curvature times the twisting torque), and the Hessian is
    # the symmetric part.
    symmetric = 0.5 * (jacobian + jacobian.T)
    np.testing.assert_allclose(hessian, symmetric, atol=1e-7 * np.abs(hessian).max())


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    axis = axis / np.linalg.norm(axis)
    cross = np.array(
        [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]], dtype=float
    )
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_rigid_motion_leaves_the_energy_and_turns_the_forces():
    rod = Rod.uniform(**COMMON, clamp="free", rest_curvature=(3.0, -2.0), rest_twist=4.0)
    state = bent_state(rod, 6)
    turn = rotation(np.array([1.0, -2.0, 0.5]), 1.1)
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
