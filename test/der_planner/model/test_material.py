"""Unequal chambers, stiffening, friction and creep as pressures; how a limb gives way to forces."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments

from der_planner.limb import Limb
from der_planner.model import RodModel
from der_planner.model.compliance import compliance
from der_planner.model.material import Material


def felt(limb, differential, bend):
    """Effective pressures (K, M) [Pa] of chamber pressures along a known bend."""
    material = Material(limb)
    return material.without_memory(differential, material.memory_pressures(TIME, bend))


def rubbing(**changes: float) -> Limb:
    return with_segments(
        Limb.default(),
        gain_asymmetry=0.05,
        pressure_stiffening=5e-6,
        friction_moment=lambda s: 400 * s.moment_gain,
        friction_curvature=lambda s: 0.1 / s.length,
        creep_stiffness=lambda s: 500 * s.moment_gain * s.length,
        creep_time=8.0,
        rest_curvature=0.2,
        coupling_before=0.04,
        coupling_after=-0.03,
        **changes,
    )


TIME = np.arange(600) * 0.05
BEND = 0.6 * np.stack([np.sin(TIME / 3), np.cos(TIME / 2) - 1], axis=1)
WANTED = 11_000.0 * np.stack([np.sin(TIME / 3), np.sin(TIME / 5)], axis=1)


def law(limb, differential, time, angles):
    """Effective pressures (K, M) [Pa], instant by instant, as the page writes the law."""
    result = np.empty_like(differential)
    z, q = np.zeros(2), np.zeros(2)
    for k in range(len(time)):
        for i, s in enumerate(limb.segments):
            if k:
                turned = angles[k, i] - angles[k - 1, i]
                side = 1.0 if turned >= 0 else -1.0
                fade = np.exp(-abs(turned) / (s.friction_curvature * s.length))
                z[i] = side - (side - z[i]) * fade
                elapsed = (time[k] - time[k - 1]) / s.creep_time
                filled = (1 - np.exp(-elapsed)) / elapsed
                q[i] = q[i] * np.exp(-elapsed) + turned / s.length * filled
            own, other = differential[k, i], differential[k, 1 - i]
            share = s.coupling_after if i == 0 else s.coupling_before
            driven = own * (1 + s.gain_asymmetry * np.sign(own)) + share * other
            held = (s.friction_moment * z[i] + s.creep_stiffness * q[i]) / s.moment_gain
            result[k, i] = (driven - held) / (1 + s.pressure_stiffening * abs(own))
    return result


def test_pressures_are_felt_by_the_law():
    # The first segment has none before it, the last none after it.
    coupling = {"coupling_before": [0.3, 0.04], "coupling_after": [-0.03, 0.2]}
    limb = with_segments(rubbing(), gain_asymmetry=[0.05, -0.04], **coupling)
    expected = law(limb, WANTED, TIME, BEND)
    np.testing.assert_allclose(felt(limb, WANTED, BEND), expected, atol=1e-7)
    assert np.abs(expected - WANTED).max() > 300.0


def test_differential_and_effective_pressure_are_inverse():
    limb = rubbing()
    given = Material(limb).differential_pressure(TIME, WANTED, BEND)
    np.testing.assert_allclose(felt(limb, given, BEND), WANTED, atol=1e-8)
    assert np.abs(given - WANTED).max() > 300.0


def test_resting_bend_is_where_moment_and_effective_pressure_agree():
    cubic = 0.3
    limb = rubbing()
    limb = with_segments(limb, cubic_stiffness=lambda s: cubic * s.bending_stiffness * s.length**2)
    bend = Material(limb).resting_bend(TIME, WANTED)
    effective = felt(limb, WANTED, bend)
    bent = bend - np.array([s.rest_curvature * s.length for s in limb.segments])
    held = bent + cubic * bent**3
    np.testing.assert_allclose(held[1:], (limb.static_gain * effective)[1:], atol=1e-9)


@pytest.mark.parametrize("mounting", ["horizontal", "sideways"])
@pytest.mark.parametrize(
    "name", ["moment_gain", "friction_moment", "friction_curvature", "creep_time", "rest_curvature"]
)
def test_the_bend_at_rest_changes_as_the_difference_of_two(name, mounting):
    limb, step = rubbing().mounted(mounting), 1e-4
    material, pressures = Material(limb), 0.5 * WANTED
    rest = material.resting_bend(TIME, pressures)
    nudged = Material(with_segments(limb, **{name: lambda s: (1.0 + step) * getattr(s, name)}))
    driven = (m.driven_bend(TIME, pressures, rest) for m in (nudged, material))
    change = (next(driven) - next(driven))[..., None] / step
    found = material.resting_bend_change(TIME, pressures, rest, change)[..., 0]
    expected = (nudged.resting_bend(TIME, pressures) - rest) / step
    # Where a bend turns round between two instants, only the difference knows of it.
    off = np.abs(found - expected).max(axis=1)
    assert np.quantile(off, 0.95) < 0.02 * np.abs(expected).max()


def test_too_much_stiffening_is_refused_by_its_name():
    limb = with_segments(rubbing(), pressure_stiffening=1e-4)
    with pytest.raises(ValueError, match="pressure_stiffening"):
        Material(limb).differential_pressure(TIME, WANTED, BEND)


LIMB = replace(Limb.default(), connector_length=0.0, base_length=0.0)
LENGTH = LIMB.length
EI = LIMB.segments[0].bending_stiffness


@pytest.fixture(scope="module")
def model():
    return RodModel(LIMB, nodes=81)


@pytest.mark.parametrize("share", [0.4, 0.75, 1.0])
def test_a_force_across_a_straight_limb(model, share):
    """Euler-Bernoulli: a³/3EI where it acts, a²(3L − a)/6EI at the tip, turned by a²/2EI."""
    at = share * LENGTH
    found = compliance(model, [0.0, 0.0], [at])
    assert found.place[0, 1, 1] == pytest.approx(at**3 / (3 * EI), rel=5e-3)
    assert found.tip[0, 1, 1] == pytest.approx(at**2 * (3 * LENGTH - at) / (6 * EI), rel=5e-3)
    assert found.bend[0, :, 1].sum() == pytest.approx(at**2 / (2 * EI), rel=5e-3)
    # A force along a straight limb does nothing to first order.
    np.testing.assert_allclose(found.tip[0, :, 0], 0.0, atol=1e-12)


def test_pressures_bend_as_the_gains_say(model):
    found = compliance(model, [0.0, 0.0], [0.5 * LENGTH])
    np.testing.assert_allclose(found.bend_by_pressure, np.diag(LIMB.static_gain), rtol=2e-3)


def test_a_bent_limb_gives_way_as_the_rod_does():
    model = RodModel(LIMB)
    pressure = np.array([9000.0, -4000.0])
    at_rest = model.resting(pressure)
    node, force = 13, np.array([0.01, -0.02])
    forces = np.zeros((model.nodes, 3))
    forces[node, :2] = force
    pushed = model.rod.equilibrium(pressure, start=at_rest, forces=forces)
    place = float(np.cumsum(model.rod.rest_lengths)[node - 1])
    bend = model.bend_of(at_rest)
    found = compliance(model, bend, [place])
    np.testing.assert_allclose(found.tip[0] @ force, (pushed.q - at_rest.q)[-3:-1], rtol=0.03)
    np.testing.assert_allclose(found.bend[0] @ force, model.bend_of(pushed) - bend, rtol=0.03)
