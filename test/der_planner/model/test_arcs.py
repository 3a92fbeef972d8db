"""The PCC model against definitions: energies, finite differences, limits that are known."""

import dataclasses

import numpy as np
import pytest
from differences import slopes
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.model import ArcModel, arc_kernel
from der_planner.model import arc_dynamics as kernels
from der_planner.rod import Rod

SEED = 4


def limb_of(count, **changes):
    base = Limb.default()
    rng = np.random.default_rng(count)
    segments = tuple(
        dataclasses.replace(
            base.segments[0],
            length=float(rng.uniform(0.08, 0.15)),
            mass_per_length=float(rng.uniform(0.5, 1.5)),
            bending_stiffness=float(rng.uniform(0.01, 0.03)),
            **changes,
        )
        for _ in range(count)
    )
    return dataclasses.replace(base, segments=segments, connector_length=0.01)


@pytest.fixture(params=[1, 2, 3, 5], ids="{} segments".format)
def model(request):
    return ArcModel(limb_of(request.param))


def configurations(model, count=5, scale=1.2):
    rng = np.random.default_rng(SEED)
    return rng.normal(scale=scale, size=(count, 2, model.inputs))


def material_points(model, q, points=4001):
    """Points of the centreline with mass fractions, straight from the definition of an arc."""
    s = (np.arange(points) + 0.5) / points
    heading, start, result, masses = 0.0, 0j, [], []
    for j, length in enumerate(model.lengths):
        if j:
            straight = np.exp(1j * heading) * model.connector
            density = 0.5 * (model.masses / model.lengths)[j - 1 : j + 1].sum()
            result.append(start + s * straight)
            masses.append(np.full(points, density * model.connector / points))
            start += straight
        step = length / points
        middle = np.exp(1j * (heading + q[j] * s)) * step
        chain = start + np.cumsum(middle) - middle / 2
        result.append(chain)
        masses.append(np.full(points, model.masses[j] / points))
        start += middle.sum()
        heading += q[j]
    return np.concatenate(result), np.concatenate(masses)


def inertia(model, q, v):
    return kernels.force_slopes(q, v, v, model.arcs)[2]


def damping(model, q):
    return kernels.force_slopes(q, 0 * q, 0 * q, model.arcs)[1]


def energy(model, q, v):
    """Kinetic plus elastic plus gravity's potential energy [J], particle by particle."""
    arcs, bend = model.arcs, q - model.free_angles
    frame = kernels.joints(q, arcs)
    slopes = kernels.arc_slopes(q, arcs, frame, 2)
    J, H = np.zeros(q.size, dtype=complex), np.zeros((q.size, q.size), dtype=complex)
    potential = 0.0
    for p, mass in enumerate(arcs.weight):
        point = model.base + kernels.point_derivatives(q, arcs, frame, p, slopes, J, H)
        potential -= mass * (np.array([point.real, point.imag]) @ arcs.gravity)
    elastic = 0.5 * model.stiffness @ bend**2 + 0.25 * model.cubic @ bend**4
    return 0.5 * v @ inertia(model, q, v) @ v + elastic + potential


def test_inertia_is_that_of_the_kinetic_energy(model):
    for q, v in configurations(model, count=2):
        h = 1e-5
        ahead, mass = material_points(model, q + h * v)
        behind, _ = material_points(model, q - h * v)
        kinetic = 0.5 * (mass * np.abs((ahead - behind) / (2 * h)) ** 2).sum()
        assert 0.5 * v @ inertia(model, q, v) @ v == pytest.approx(kinetic, rel=1e-5)


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_arc_functions_are_right_on_both_sides_of_where_series_and_quotient_meet(order):
    eta, weight = np.polynomial.legendre.leggauss(40)
    eta, weight = (eta + 1) / 2, weight / 2
    meeting = [share * arc_kernel.SERIES_BELOW for share in (0.998, 1.002)]
    for value in (-7.0, -0.3, -1e-9, 0.0, 1e-300, *meeting, 3.0):
        exact = (weight * eta**order * np.exp(1j * value * eta)).sum()
        assert abs(arc_kernel.arc_moments(value)[order] - exact) < 1e-13


def test_tip_and_its_jacobian_agree(model):
    for q, _ in configurations(model):
        np.testing.assert_allclose(model.tip_jacobians(q), slopes(model.tip, q), atol=1e-9)
        np.testing.assert_allclose(model.curve(q)[-1], model.tip(q), atol=1e-14)


def rolled(model, pressures, step, angles=None, rates=None):
    """Angles and rates (K+1, n) from a given state, else straight, by the kernel itself."""
    still = np.zeros(model.inputs)
    q, v = (still if given is None else given for given in (angles, rates))
    return kernels.simulate(q, v, pressures, step, model.arcs, False)[:2]


def undamped(count):
    limb = limb_of(count, damping=0.0)
    return ArcModel(dataclasses.replace(limb, gravity=(2.0, -1.0, 0.0)))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_undamped_motion_keeps_its_energy(count):
    model = undamped(count)
    q0, v0 = np.linspace(0.5, -0.4, count), np.linspace(1.0, -2.0, count)
    angles, rates = rolled(model, np.zeros((100, 100, count)), 5e-5, q0, v0)
    energies = np.array([energy(model, q, v) for q, v in zip(angles, rates, strict=True)])
    swing = np.ptp([0.5 * v @ inertia(model, q, v) @ v for q, v in zip(angles, rates, strict=True)])
    assert swing > 1e-4
    assert np.ptp(energies) < 1e-5 * swing


def test_pressures_invert_the_forward_dynamics(model):
    rng = np.random.default_rng(SEED)
    q, v, a = rng.normal(size=(3, 6, model.inputs))
    pressures = model.inverse_dynamics(q, v, a)
    for k in range(len(q)):
        _, rates = rolled(model, pressures[k][None, None], 1e-9, q[k], v[k])
        np.testing.assert_allclose((rates[1] - v[k]) / 1e-9, a[k], rtol=1e-4, atol=1e-4)


def test_bad_input_is_named():
    model = ArcModel(Limb.default())
    with pytest.raises(ValueError, match="bend_angles must be 2 finite numbers"):
        model.stiffness_matrix([1.0])
    with pytest.raises(ValueError, match=r"\(K, S, 2\)"):
        model.run(model.rest, np.zeros((4, 2)), 0.01)


def loaded(count):
    """A limb under gravity with masses in a segment, on a connector and at the tip."""
    limb = limb_of(count)
    first = limb.segments[0].length
    limb = dataclasses.replace(limb, gravity=(6.0, -7.0, 0.0), base_length=0.03)
    limb = limb.carrying(0.03).carrying(0.02, at=0.03 + 0.4 * first)
    return limb.carrying(0.05, at=0.03 + first + 0.004) if count > 1 else limb


@pytest.mark.parametrize("count", [1, 2, 3])
def test_carried_masses_move_with_their_places(count):
    limb = loaded(count)
    bare = ArcModel(dataclasses.replace(limb, masses=()))
    model = ArcModel(limb)
    for q, v in configurations(model, count=3):

        def places(angles):
            curve = bare.curve(angles, points_per_segment=500)
            steps = np.append(0.0, np.cumsum(np.hypot(*np.diff(curve, axis=0).T)))
            s = np.array([m.arc_length for m in limb.masses]) * steps[-1] / limb.length
            return np.stack([np.interp(s, steps, axis) for axis in curve.T], axis=1)

        h = 1e-4
        mass = np.array([m.mass for m in limb.masses])
        rate = (places(q + h * v) - places(q - h * v)) / (2 * h)
        added = 0.5 * v @ (inertia(model, q, v) - inertia(bare, q, v)) @ v
        assert added == pytest.approx(0.5 * (mass * (rate**2).sum(axis=1)).sum(), rel=1e-4)
        height = -places(q) @ np.array(limb.gravity[:2])
        assert energy(model, q, 0 * q) - energy(bare, q, 0 * q) == pytest.approx(
            (mass * height).sum(), rel=1e-4
        )
        np.testing.assert_allclose(damping(model, q), damping(bare, q), rtol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_pressures_at_rest_balance_the_gradient_of_the_energy(count):
    model = ArcModel(loaded(count))
    zero = np.zeros(count)
    for q, _ in configurations(model, count=3):
        slope = slopes(lambda angles: energy(model, angles, zero), q)
        torque = model.inverse_dynamics(q, zero, zero)[0] * model.gain
        np.testing.assert_allclose(torque, slope, rtol=1e-6, atol=1e-9)


def test_the_error_falls_with_the_cube_of_the_step():
    model = ArcModel(loaded(2))

    def angles(parts):
        steps = np.full((20, parts, 2), 5e3)
        return rolled(model, steps, 2e-3 / parts, np.array([0.4, -0.2]), np.array([1.0, 2.0]))[0]

    errors = [np.abs(angles(parts) - angles(32)).max() for parts in (1, 2)]
    assert errors[0] < 0.01
    assert 7.0 < errors[0] / errors[1] < 9.0


def test_a_stiff_and_damped_limb_comes_to_rest_in_long_steps():
    changes = {"bending_stiffness": lambda s: 60 * s.bending_stiffness, "material_damping": 0.1}
    model = ArcModel(with_segments(limb_of(3), **changes))
    angles, _ = rolled(model, np.full((40, 1, 3), 5e4), 0.05)
    rest = model.resting(np.full(3, 5e4)).angles
    np.testing.assert_allclose(angles[-1], rest, atol=1e-6)
    assert np.abs(angles).max() < 1.01 * np.abs(rest).max()


@pytest.mark.parametrize(("size", "error"), [(4e3, 1e-10), (4e4, 1e-8)], ids=["usual", "violent"])
def test_linearisation_against_the_simulation(size, error):
    model = ArcModel(loaded(2))
    rng = np.random.default_rng(SEED)
    pressures = size * rng.normal(size=(12, 5, 2))
    start, rates = np.array([0.4, -0.2]), np.array([1.0, 2.0])
    linear = model.run(model.state(start, rates), pressures, 0.05, "all").linear
    change, shift = rng.normal(size=pressures.shape), 1e-4 * rng.normal(size=2)
    ends = [
        rolled(model, pressures + s * change, 0.01, start + s * shift, rates)[0]
        for s in (1.0, -1.0)
    ]
    _, moved = linear.tangent(change, shift)
    np.testing.assert_allclose(moved, (ends[0] - ends[1]) / 2, rtol=1e-5, atol=error)
    pulse = rng.uniform(size=(9, 2))
    raised = np.zeros((14, 5, 2))
    raised.reshape(-1, 2)[15:24] = pulse * [0.0, 1.0]
    column = linear.sensitivity(pulse)[:, :, 3, 1]
    np.testing.assert_allclose(column, linear.tangent(raised[:12])[0], rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("mounting", ["hanging", "sideways", "25"])
def test_many_arcs_rest_as_the_rod_does(mounting):
    base = Limb.default()
    count = 12
    part = dataclasses.replace(base.segments[0], length=base.length / count)
    limb = dataclasses.replace(base, segments=(part,) * count).mounted(mounting).carrying(0.03)
    model = ArcModel(limb)
    tip = model.tip(model.rest.angles)
    rod = Rod.from_limb(base.mounted(mounting).carrying(0.03), 61)
    np.testing.assert_allclose(tip, rod.tip(rod.equilibrium(np.zeros(2)))[:2], atol=1e-3)
