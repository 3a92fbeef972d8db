"""Exact derivatives of steps and motions, against finite differences and against each other."""

import dataclasses

import numpy as np
import pytest
from differences import slopes
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.rod import ConvergenceError, Rod, integration

METHODS = ["sdirk2", "midpoint", "backward_euler"]


def limb_rod(**options) -> Rod:
    limb = dataclasses.replace(Limb.default(), gravity=(0.3, -2.0, 0.0))
    return Rod.from_limb(with_segments(limb, **options))


def spatial_rod() -> Rod:
    return Rod.uniform(
        length=0.2, nodes=8, EI=0.02, EA=500.0, GJ=0.015, mass_per_length=1.0, damping=0.5,
        gravity=(0, -3, -9.81), segments=[(0, 4), (4, 4)], moment_gain=[1e-5, 1.2e-5],
        material_damping=0.02, rest_curvature=(2, 3), rest_twist=4.0,
    )  # fmt: skip


def moving_state(rod: Rod, seed: int):
    random = np.random.default_rng(seed)
    state = rod.equilibrium(random.normal(size=2) * 4e3)
    for _ in range(4):
        forces = random.normal(size=(rod.nodes, 3)) * 0.05
        if rod.plane is not None:
            forces[:, 2] = 0.0
        state = rod.step(state, random.normal(size=2) * 1e4, 0.01, forces=forces)
    return state


def in_chart(rod: Rod, state, nominal) -> np.ndarray:
    """Free (q, v) of a state, its angles counted from frames transported from the nominal state."""
    carried = rod.state(state.q, state.v, like=nominal)
    tangents = np.diff(state.positions, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    across = np.cross(carried.directors, state.directors)
    q = state.q.copy()
    q[3::4] += np.arctan2(
        np.sum(tangents * across, axis=1), np.sum(carried.directors * state.directors, axis=1)
    )
    return np.concatenate([q[rod.free], state.v[rod.free]])


def step_by_differences(rod, state, u, dt, method):
    nominal, count = rod.step(state, u, dt, method), len(rod.free)

    def end(given):  # pressures in MPa, so that one step suits all
        q, v = state.q.copy(), state.v.copy()
        q[rod.free], v[rod.free] = given[:count], given[count : 2 * count]
        moved = rod.step(rod.state(q, v, like=state), 1e6 * given[2 * count :], dt, method)
        return in_chart(rod, moved, nominal)

    both = slopes(end, np.concatenate([state.q[rod.free], state.v[rod.free], 1e-6 * u]))
    return both[:, : 2 * count], 1e-6 * both[:, 2 * count :]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "rod",
    [
        pytest.param(limb_rod(), id="planar"),
        pytest.param(limb_rod(material_damping=0.03, cubic_stiffness=1e-5), id="planar viscous"),
        pytest.param(spatial_rod(), id="space"),
    ],
)
def test_linearised_step_is_the_derivative_of_the_step(rod, method):
    state = moving_state(rod, 1)
    u = np.array([9e3, -6e3])
    A, B = rod.linearise_step(state, u, 0.01, method)
    expected_A, expected_B = step_by_differences(rod, state, u, 0.01, method)
    np.testing.assert_allclose(A, expected_A, atol=1e-6 * np.abs(A).max())
    np.testing.assert_allclose(B, expected_B, atol=1e-6 * np.abs(B).max())


@pytest.fixture(
    scope="module",
    params=[
        *(("planar", method) for method in METHODS),
        *(("space", method) for method in METHODS),
    ],
    ids=" ".join,
)
def motion(request):
    kind, method = request.param
    rod = limb_rod(material_damping=0.01) if kind == "planar" else spatial_rod()
    start = rod.equilibrium([1e3, -1e3])
    time = np.arange(30)[:, None] * 0.05
    u = 8e3 * np.sin(3 * time + [0.0, 1.0])
    run = rod.simulate(start, u, 0.05, substeps=3, method=method, linearise=True)
    return rod, start, u, method, run


def test_tangent_is_the_derivative_by_pressures_and_initial_state(motion):
    rod, start, u, method, run = motion
    random = np.random.default_rng(3)
    count = len(rod.free)
    change = random.normal(size=u.shape) * 0.1
    dq, dv = random.normal(size=count) * 1e-6, random.normal(size=count) * 1e-5
    predicted = run.linearisation.tangent(change, (dq, dv))
    outputs = run.linearisation.outputs
    ends = []
    for sign in (1, -1):
        q, v = start.q.copy(), start.v.copy()
        q[rod.free] += sign * dq
        v[rod.free] += sign * dv
        moved, pressed = rod.state(q, v, like=start), u + sign * change
        ends.append(rod.simulate(moved, pressed, 0.05, substeps=3, method=method).q[:, outputs])
    expected = (ends[0] - ends[1]) / 2
    np.testing.assert_allclose(predicted, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("kind", ["planar", "space"])
def test_the_linearisation_of_a_cut_step_is_its_derivative(kind, monkeypatch):
    """A jolt that a step of 0.1 s cannot follow, in space with fewer iterations than it takes."""
    if kind == "space":
        monkeypatch.setattr(integration, "_LIMIT", 12)
    gravity = (0.3, -2.0, 0.0 if kind == "planar" else -2.0)
    rod = Rod.from_limb(dataclasses.replace(Limb.default(), gravity=gravity))
    start = rod.equilibrium([0.0, 0.0])
    u = np.array([[1e3, 1e3], [1e5, -1e5], [2e3, 1e3], [0.0, 1e3]])
    with pytest.raises(ConvergenceError, match=r"step 1 of 0\.1 s"):
        rod.simulate(start, u, 0.1, method="backward_euler", halvings=0)
    run = rod.simulate(start, u, 0.1, method="backward_euler", linearise=True)
    solves = np.bincount(run.linearisation.chain.steps, minlength=4)
    assert solves[0] == 1
    assert solves[1] > 1
    change = np.random.default_rng(8).normal(size=u.shape)
    outputs = run.linearisation.outputs
    ends = [
        rod.simulate(start, u + sign * change, 0.1, method="backward_euler").q[:, outputs]
        for sign in (1, -1)
    ]
    expected = (ends[0] - ends[1]) / 2
    predicted = run.linearisation.tangent(change)
    np.testing.assert_allclose(predicted, expected, atol=1e-4 * np.abs(expected).max())


def test_an_angle_that_is_held_while_its_edge_moves():
    """A held twist of the tip's edge: the frames turn below it, and the tangent knows."""
    free = spatial_rod()
    held = np.append(free.mesh.clamped, 4 * free.nodes - 5)
    rod = Rod(dataclasses.replace(free.mesh, clamped=held))
    start = rod.equilibrium([1e3, -1e3])
    u = 8e3 * np.sin(3 * np.arange(20)[:, None] * 0.05 + [0.0, 1.0])
    run = rod.simulate(start, u, 0.05, linearise=True)
    change = np.random.default_rng(10).normal(size=u.shape) * 10
    ends = [rod.simulate(start, u + sign * change, 0.05).tip for sign in (1, -1)]
    expected = (ends[0] - ends[1]) / 2
    predicted = run.linearisation.tangent(change)
    np.testing.assert_allclose(predicted, expected, atol=1e-5 * np.abs(expected).max())


def test_sensitivity_is_the_matrix_of_the_tangent(motion):
    linearisation = motion[-1].linearisation
    matrix = linearisation.sensitivity()
    assert matrix.shape == (31, len(linearisation.outputs), 30, 2)
    change = np.random.default_rng(5).normal(size=(30, 2))
    np.testing.assert_allclose(
        np.einsum("kpjm,jm->kp", matrix, change), linearisation.tangent(change), atol=1e-12
    )
    for j in (0, 7, 29):
        assert not matrix[: j + 1, :, j].any()
        assert matrix[j + 1, :, j].any()


def test_sensitivity_to_a_pulse_of_the_pneumatics(motion):
    linearisation = motion[-1].linearisation
    pulse = np.stack([np.linspace(0, 1, 8), np.linspace(1, 0.2, 8)], axis=1)
    matrix = linearisation.sensitivity(pulse)
    for j, m in ((0, 0), (4, 1), (29, 1)):
        by_step = np.zeros((90, 2))
        part = pulse[: 90 - 3 * j, m]
        by_step[3 * j : 3 * j + len(part), m] = part
        expected = linearisation.tangent(by_step.reshape(30, 3, 2))
        np.testing.assert_allclose(matrix[:, :, j, m], expected, atol=1e-13)


@pytest.mark.parametrize(
    "rod", [limb_rod(cubic_stiffness=1e-5), spatial_rod()], ids=["plane", "space"]
)
def test_linearised_equilibrium_is_its_derivative(rod):
    u = np.array([4e3, -3e3])
    state = rod.equilibrium(u)
    found = rod.linearise_equilibrium(state, u)
    expected = slopes(lambda pressures: rod.equilibrium(pressures, start=state).q, u, 1.0)
    for column, known in zip(found.T, expected.T, strict=True):
        np.testing.assert_allclose(column, known, atol=1e-5 * np.abs(column).max())
