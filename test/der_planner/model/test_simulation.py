"""`simulate`: values against the laws of air and material, derivatives against finite differences.

Every term of air and material is on: a friction that turns round over a bend 10 % off, or a lag
that is forgotten, breaks these tests.
"""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_air, with_segments

from der_planner.limb import VENT_REFERENCE, Limb
from der_planner.model import CONTROL_PERIOD, STEPS, Initial, Material, Model, RodModel, simulate
from der_planner.model.bending import bend_angles


def everything() -> Limb:
    limb = with_air(
        Limb.default(), time_constant=0.3, vent_time_constant=0.13, delay=0.03, vent_rate=5300.0
    )
    return with_segments(
        limb,
        gain_asymmetry=[0.05, -0.04],
        pressure_stiffening=4e-6,
        rest_curvature=[0.3, -0.2],
        cubic_stiffness=lambda s: 0.06 * s.bending_stiffness * s.length**2,
        material_damping=0.01,
        friction_moment=lambda s: 400 * s.moment_gain,
        friction_curvature=lambda s: 0.12 / s.length,
        creep_stiffness=lambda s: 500 * s.moment_gain * s.length,
        creep_time=8.0,
        coupling_before=[0.03, -0.02],
        coupling_after=[-0.03, 0.02],
    )


LIMB = everything()
COUNT = 80
TIME = CONTROL_PERIOD * np.arange(COUNT)
COMMANDS = 7e3 * np.column_stack([np.sin(1.7 * TIME) + 0.2, np.cos(1.3 * TIME)])


def bend(time):
    return 0.6 * np.stack([np.sin(1.7 * time - 0.4), np.cos(1.3 * time - 0.5)], axis=1)


def integrated_chambers(commands):
    """Both chambers of each pair by explicit Euler steps of 0.1 ms; differential amid 10 ms."""
    air, h, fine = LIMB.pneumatics, 1e-4, 100
    pair = np.zeros((2, 2))
    result = np.empty((len(commands) * STEPS, 2))
    for n in range(len(commands) * STEPS * fine):
        late = n * h - air.delay
        k = int(np.floor((late + 1e-9) / CONTROL_PERIOD))
        given = commands[k] if k >= 0 else np.zeros(2)
        wanted = np.stack([np.maximum(given, 0), np.maximum(-given, 0)], axis=1)
        if n % fine == fine // 2:
            result[n // fine] = pair[:, 0] - pair[:, 1]
        rate = (wanted - pair) / np.where(pair <= wanted, air.time_constant, air.vent_lag)
        slowest = air.vent_rate * (np.maximum(pair, 0) / VENT_REFERENCE) ** air.vent_exponent
        pair = pair + h * np.where(rate < 0, np.maximum(rate, -slowest), rate)
    return result


def test_commands_become_pressures_and_shape_by_the_laws():
    response = simulate(LIMB, TIME, commands=COMMANDS, bend=bend)
    differential = response.differential_pressure.reshape(-1, 2)
    assert np.abs(differential - integrated_chambers(COMMANDS)).max() < 25.0
    middle = (np.arange(COUNT * STEPS) + 0.5) * 0.01
    material = Material(LIMB)
    effective = material.without_memory(
        differential, material.memory_pressures(middle, bend(middle))
    )
    np.testing.assert_allclose(response.effective_pressure.reshape(-1, 2), effective, atol=1e-7)
    model = RodModel(LIMB)
    moved = model.rod.simulate(
        model.rest, effective.reshape(COUNT, STEPS, 2), CONTROL_PERIOD, substeps=STEPS
    )
    np.testing.assert_allclose(response.tip, moved.tip[:, :2], atol=1e-10)
    np.testing.assert_allclose(response.bend_angles, bend_angles(model.rod, moved.q), atol=1e-9)


LOADED = LIMB.mounted("25").carrying(0.02)


@pytest.mark.parametrize("given", ["commands", "pressures"])
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("model", ["der", "pcc"])
@pytest.mark.parametrize("limb", [LIMB, LOADED], ids=["free", "loaded"])
def test_derivatives_against_finite_differences(model, given, known, limb):
    options = {"bend": bend if known else None}
    model = Model.of(limb, model)
    response = simulate(model, TIME, **{given: COMMANDS}, **options, linearise=True)
    rng = np.random.default_rng(4)
    direction = rng.normal(size=COMMANDS.shape)
    step = 0.02
    ends = [
        simulate(model, TIME, **{given: COMMANDS + sign * step * direction}, **options)
        for sign in (1, -1)
    ]
    tip, bent = response.derivative.tangent(direction)
    for exact, name in ((tip, "tip"), (bent, "bend_angles")):
        slope = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * step)
        assert np.abs(exact - slope).max() < 2e-4 * np.abs(slope).max(), name


def test_friction_creep_and_shape_go_on_from_where_they_were():
    material, half = Material(LIMB), COUNT // 2
    whole = material.remember(TIME, bend(TIME))
    first = material.remember(TIME[: half + 1], bend(TIME[: half + 1]))
    second = material.remember(TIME[half:], bend(TIME[half:]), first.at(-1))
    assert np.abs(first.at(-1).friction).max() > 0.5
    np.testing.assert_allclose(second.friction, whole.friction[half:], atol=1e-9)
    np.testing.assert_allclose(second.creep, whole.creep[half:], atol=1e-9)
    limb = Limb.default()
    moved = simulate(limb, TIME, pressures=COMMANDS)
    begun = simulate(limb, TIME[: half + 1], pressures=COMMANDS[: half + 1]).final
    on = simulate(limb, TIME[half:], pressures=COMMANDS[half:], initial=Initial(begun))
    np.testing.assert_allclose(on.bend_angles, moved.bend_angles[half:], atol=1e-9)


@pytest.mark.parametrize("mounting", ["10", "hanging", "sideways"])
def test_the_bend_at_rest_of_a_loaded_limb_is_nearly_the_rods(mounting):
    """Friction and creep act along it; that a loaded rod bends unevenly is left out."""
    limb = replace(Limb.default(), connector_length=0.006, base_length=0.005)
    limb = limb.mounted(mounting).carrying(0.02, 0.2)
    model = RodModel(limb, 41)
    for pressures in ([0.0, 0.0], [9e3, -5e3], [-6e3, -12e3]):
        series = np.tile(pressures, (2, 1))
        found = Material(limb).resting_bend(np.array([0.0, 1.0]), series)[0]
        rests = model.resting(np.array(pressures, dtype=float))
        truth = bend_angles(model.rod, rests.q[None])[0]
        free = Material(limb.mounted("horizontal")).resting_bend(np.array([0.0, 1.0]), series)[0]
        assert np.abs(found - truth).max() < 0.01 + 0.25 * np.abs(free - truth).max()


@pytest.mark.parametrize("model", ["der", "pcc"])
def test_rod_and_arcs_rest_where_the_material_says(model):
    pressures = np.tile([6e3, -4e3], (400, 1))
    response = simulate(Model.of(LIMB, model), CONTROL_PERIOD * np.arange(400), pressures=pressures)
    resting = Material(LIMB).resting_bend(CONTROL_PERIOD * np.arange(400), pressures)
    np.testing.assert_allclose(response.bend_angles[-1], resting[-1], atol=5e-3)


def test_wrong_input_is_named():
    with pytest.raises(ValueError, match="either commands or pressures"):
        simulate(LIMB, TIME)
    with pytest.raises(ValueError, match=r"\(K, 2\)"):
        simulate(LIMB, TIME, commands=COMMANDS[:-1])
    with pytest.raises(ValueError, match=r"must be finite .* in row 1"):
        simulate(LIMB, TIME, commands=np.where(TIME[:, None] == TIME[1], np.nan, COMMANDS))
    with pytest.raises(ValueError, match="evenly spaced"):
        simulate(LIMB, TIME**2, commands=COMMANDS)
    with pytest.raises(ValueError, match="give rising seconds"):
        simulate(LIMB, 1000.0 * TIME, commands=COMMANDS)


@pytest.mark.parametrize("model", ["der", "pcc"])
def test_mass_that_resists_and_mass_that_weighs_are_told_apart(model):
    # What weighs 1 and resists 0.8 is what resists 0.8 and is pulled at 1 / 0.8 as strongly.
    limb = everything().mounted("30")
    slow = with_segments(limb, swing_inertia=0.8)
    same = with_segments(
        replace(limb, gravity=tuple(g / 0.8 for g in limb.gravity)),
        mass_per_length=lambda s: 0.8 * s.mass_per_length,
        damping=lambda s: s.damping / 0.8,
    )
    time = np.arange(0.0, 2.0, 0.05)
    pressures = 6000.0 * np.sin(np.outer(time, [3.0, 7.0]))
    tips = [
        simulate(Model.of(each, model), time, pressures=pressures).tip
        for each in (slow, same, limb)
    ]
    assert tips[0] == pytest.approx(tips[1], abs=1e-8)
    assert tips[0][0] == pytest.approx(tips[2][0], abs=1e-8)  # at rest it does not count
    assert np.abs(tips[0] - tips[2]).max() > 1e-3
