"""Chambers that are vented slowly: the law, its derivatives, its inverse, plans that know it."""

import dataclasses

import numpy as np
import pytest
from limbs import with_air

from der_planner.limb import VENT_REFERENCE, Limb
from der_planner.model import Model, commands
from der_planner.model.air import Air
from der_planner.planning import Motion, plan, planner
from der_planner.planning.configuration import configure

LIMB = Limb.default()


def slow(**air):
    values = {"time_constant": 0.3, "vent_time_constant": 0.13, "vent_rate": 5300.0, **air}
    return with_air(LIMB, **values)


@pytest.mark.parametrize("exponent", [0.5, 2 / 3, 1.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_vented_chamber_falls_by_the_law(exponent, sign):
    air = slow(vent_time_constant=0.01, vent_exponent=exponent, delay=0.0).pneumatics
    start = 7000.0
    chambers = Air(air).follow(np.zeros((60, 1)), 0.05, 5, [sign * start]).differential
    pressure = sign * chambers.ravel()
    time = (np.arange(300) + 0.5) * 0.01
    rate = air.vent_rate / VENT_REFERENCE
    if exponent == 1.0:
        exact = start * np.exp(-rate * time)
    else:
        power = 1 - exponent
        left = (start / VENT_REFERENCE) ** power - power * rate * time
        exact = VENT_REFERENCE * np.maximum(left, 0.0) ** (1 / power)
    # Close to zero the lag, here almost none, takes over.
    high = exact > 200.0
    assert high.sum() > 200
    np.testing.assert_allclose(pressure[high], exact[high], rtol=1e-9)


@pytest.mark.parametrize("delay", [0.0, 0.037])
@pytest.mark.parametrize(("exponent", "valve"), [(2 / 3, 0.0), (1.0, 0.0), (0.5, 0.6)])
def test_derivatives_by_commands_against_finite_differences(delay, exponent, valve):
    air = slow(delay=delay, vent_exponent=exponent, vent_lag_exponent=valve).pneumatics
    rng = np.random.default_rng(3)
    time = np.arange(120) * 0.05
    command = 6e3 * np.column_stack([np.sin(2 * time) ** 3, np.cos(1.3 * time)])
    command += rng.normal(scale=50.0, size=command.shape)
    before = np.array([500.0, 6000.0])
    exact = Air(air).follow(command, 0.05, 5, before).derivative(40)
    limited = np.isclose(exact[..., 0].sum(axis=(0, 1)), 0.0)
    assert 5 < limited.sum() < 60, "some commands move nothing, most do"
    for _ in range(3):
        direction = np.zeros_like(command)
        direction[40:] = rng.normal(size=(80, 2))
        ahead, behind = (
            Air(air).follow(command + step * direction, 0.05, 5, before).differential
            for step in (1e-3, -1e-3)
        )
        slope = ((ahead - behind) / 2e-3)[40:]
        moved = np.einsum("nsjm,jm->nsm", exact, direction[40:])
        np.testing.assert_allclose(moved, slope, atol=1e-6)


def test_a_valve_that_opens_in_proportion_to_its_error_by_small_explicit_steps():
    """From 12 kPa toward 0.7 kPa, where its lag is four times that at 10 kPa, then to nothing."""
    air = slow(vent_exponent=0.5, vent_lag_exponent=0.5, delay=0.0).pneumatics
    command = np.repeat([700.0, 0.0], [140, 60])[:, None]
    chambers = Air(air).follow(command, 0.05, 5, [12_000.0]).differential.ravel()
    pressure, h = 12_000.0, 1e-4
    for k, goal in enumerate(np.repeat(command.ravel(), 500)):
        if k % 100 == 50:
            assert chambers[k // 100] == pytest.approx(pressure, abs=15.0)
        share = (pressure / VENT_REFERENCE) ** 0.5
        opening = np.inf if goal == 0 else (pressure - goal) / air.vent_time_constant
        pressure -= h * share * min(opening, air.vent_rate)
        pressure = max(pressure, 0.0)


@pytest.mark.parametrize("valve", [0.0, 0.5])
def test_what_lies_longer_back_than_the_memory_is_forgotten(valve):
    air = slow(vent_lag_exponent=valve).pneumatics
    count = int(np.ceil((Air(air).vent_memory + 25 * 0.13) / 0.05))
    full = np.full(1, air.pressure_limit)
    pressure = Air(air).follow(np.zeros((count, 1)), 0.05, 5, full).differential
    assert pressure[-1, -1, 0] < 0.2


def test_commands_invert_slow_venting():
    limb = slow(slew_limit=1e6, delay=0.03)
    fine = np.arange(401) * 0.025
    wanted = np.column_stack([5e3 * (1 - np.cos(1.3 * fine)), 6e3 * np.sin(1.1 * fine)])
    command = commands.commands(Air(limb.pneumatics), fine, wanted, 0.05)
    middle = (np.arange(len(command)) + 0.5) * 0.05
    exact = np.column_stack([np.interp(middle, fine, column) for column in wanted.T])
    ignorant = dataclasses.replace(limb.pneumatics, vent_rate=0.0)
    unaware = commands.commands(Air(ignorant), fine, wanted, 0.05)
    known, unknown = (
        np.sqrt(((chambers.mean(axis=1) - exact)[20:] ** 2).mean())
        for chambers in (
            Air(limb.pneumatics).follow(given, 0.05, 5).differential for given in (command, unaware)
        )
    )
    assert known < 150.0
    assert known < 0.1 * unknown


@pytest.mark.parametrize(
    ("model", "method"), [("der", "optimal"), ("der", "paper"), ("pcc", "projected")]
)
def test_a_plan_faster_than_the_chambers_vent_warns_and_a_slow_one_does_not(model, method):
    fast = plan(slow(), Motion.named("same_direction", period=6.0, cycles=1), model, method)
    said = [w for w in fast.warnings if "its chamber is vented by" in w]
    assert len(said) == 1
    assert "a longer period or a smaller amplitude" in said[0]
    which = method if method != "optimal" else "projected"
    _, numbers = planner.balance(_configuration(fast), fast.reference, which)
    assert numbers is not None
    assert numbers.wanted > 1.2 * numbers.possible
    assert f"fall by {numbers.wanted:.0f} Pa/s" in said[0]
    calm = plan(slow(), Motion.named("same_direction", period=20.0, cycles=1), model, method)
    assert calm.warnings == ()


def _configuration(result):
    return configure(Model.of(result.limb, result.model), result.reference)


@pytest.mark.parametrize("name", ["asynchronous", "same_direction", "opposite_direction"])
def test_optimal_makes_more_of_slow_chambers_than_a_balance(name):
    motion = Motion.named(name, period=6.0, cycles=1)
    best, balance = (plan(slow(), motion, "der", method) for method in ("optimal", "projected"))
    ignorant = plan(slow(vent_rate=0.0), motion, "der", "optimal")
    told = _configuration(best)
    tip = told.response(ignorant.differential_pressure, told.bend_at).tip[:-1]
    unknown = np.linalg.norm(tip - best.tip_reference, axis=1).mean()
    assert best.predicted_error < 0.7 * balance.predicted_error
    assert balance.predicted_error < 0.75 * unknown
    steps = np.diff(best.differential_pressure, axis=0, prepend=0.0)
    assert np.abs(steps).max() <= LIMB.pneumatics.slew_limit * 0.05 + 1e-6
