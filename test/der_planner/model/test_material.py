"""Unequal chambers, stiffening, friction and creep as pressures."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments

from der_planner.limb import Limb, LimbError
from der_planner.model.material import Material, dahl, maxwell


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


def test_differential_and_effective_pressure_are_inverse():
    limb = rubbing()
    given = Material(limb).differential_pressure(TIME, WANTED, BEND)
    np.testing.assert_allclose(felt(limb, given, BEND), WANTED, atol=1e-8)
    assert np.abs(given - WANTED).max() > 300.0


def test_friction_saturates_closes_its_loops_and_does_not_depend_on_rate():
    angle = np.concatenate(
        [np.linspace(0, 2, 400), np.linspace(2, -2, 800), np.linspace(-2, 2, 800)]
    )
    z = dahl(angle, 0.1)
    assert np.abs(z).max() <= 1.0
    assert z[399] == pytest.approx(1.0, abs=1e-6)
    assert z[1199] == pytest.approx(-1.0, abs=1e-6)
    np.testing.assert_allclose(z[-1], z[399], atol=1e-6)
    np.testing.assert_allclose(dahl(angle[::4], 0.1)[-1], z[-1], atol=1e-6)
    # half way round after 0.1 ln 2 from saturation
    turned = dahl(np.array([0.0, 5.0, 5.0 - 0.1 * np.log(2)]), 0.1)
    assert turned[-1] == pytest.approx(0.0, abs=1e-12)


def test_creep_relaxes_exponentially():
    time = np.linspace(0, 20, 401)
    strain = np.where(time > 0, 1.0, 0.0)
    q = maxwell(time, strain, 4.0)
    np.testing.assert_allclose(q[1:], q[1] * np.exp(-(time[1:] - time[1]) / 4.0), rtol=1e-12)


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


def test_coupling_adds_the_share_of_the_neighbours_pressure():
    limb = Limb.default()
    coupled = with_segments(limb, coupling_after=[0.04, 0.0], coupling_before=[0.0, -0.02])
    found = felt(coupled, WANTED, BEND)
    expected = WANTED + WANTED[:, ::-1] * [0.04, -0.02]
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    alone = with_segments(limb, coupling_before=[0.04, 0.0])
    np.testing.assert_array_equal(felt(alone, WANTED, BEND), WANTED)
    with pytest.raises(LimbError, match="coupling_after"):
        with_segments(limb, coupling_after=[0.6, 0.0])


def test_too_much_stiffening_is_refused_by_its_name():
    limb = with_segments(rubbing(), pressure_stiffening=1e-4)
    with pytest.raises(ValueError, match="pressure_stiffening"):
        Material(limb).differential_pressure(TIME, WANTED, BEND)


def test_limb_file_keeps_everything(tmp_path):
    limb = rubbing()
    limb = replace(limb, pcc_segments=tuple(replace(s, damping=2.0) for s in limb.segments))
    limb.to_yaml(tmp_path / "limb.yaml")
    assert Limb.from_yaml(tmp_path / "limb.yaml") == limb
    assert limb.for_model("pcc").segments == limb.pcc_segments
