"""Stiffness from a weight and from motion; the law of the chambers from logs."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from limbs import with_segments
from link_chain import LinkChain

from der_planner.identification import CalibrationLog, LogError
from der_planner.identification.air import AirFit, fit_air
from der_planner.identification.excitation import PERIOD, calibration_run, steps, waves
from der_planner.identification.log import Prepared, prepare
from der_planner.identification.report import FitReport, Unknown
from der_planner.identification.stiffness import HungWeight, stiffness_in_motion
from der_planner.identification.terms import FreeTerms, values_of
from der_planner.identification.told import against_motion, measured_stiffness
from der_planner.limb import Limb, Pneumatics, PointMass
from der_planner.model import RodModel
from der_planner.model.air import Air, pair_of
from pressure_driver.emulator import pneumatics as emulator

LIMB = Limb.default()
MASS, AT = 0.05, 0.2
STIFFER = np.array([1.4, 0.7])


def resting(gravity: tuple[float, float, float], mass: float) -> np.ndarray:
    """Return the bend (2,) [rad] of a limb of other stiffness that rests with a mass [kg]."""
    usual = LIMB.segments[0].bending_stiffness
    stiffer = with_segments(LIMB, bending_stiffness=list(STIFFER * usual))
    model = RodModel(replace(stiffer, gravity=gravity, masses=(PointMass(AT, mass),)), 41)
    return model.bend_of(model.resting(np.zeros(2)))


def recorded(before: np.ndarray, under: np.ndarray, rest: float = 40.0) -> Prepared:
    """Return a log of a motion and a rest, in which the weight hangs from 15 to 27 s."""
    time = np.arange(0.0, 10.0 + rest, 0.05)
    moving, hung = time < 10.0, (time > 25.0) & (time < 37.0)
    pressure = 8e3 * np.outer(np.sin(time), [1.0, -1.0]) * moving[:, None]
    bend = LIMB.static_gain * pressure + np.where(hung[:, None], under, before)
    noise = np.deg2rad(0.1) * np.random.default_rng(0).standard_normal(bend.shape)
    log = CalibrationLog(time, pressure, pressure, bend + noise, np.full(bend.shape, np.nan))
    return Prepared(log, pressure, bend + noise, np.ones(len(time), dtype=bool), ())


@pytest.mark.parametrize(("mounting", "held_by"), [("horizontal", 0.02), ("10", 0.0)])
def test_stiffness_follows_from_the_weight_and_friction_is_accounted_for(mounting, held_by):
    limb = LIMB.mounted(mounting)
    before = resting(limb.gravity, 0.0)
    mass = MASS if mounting == "horizontal" else 6.0 * MASS
    if mounting != "horizontal":
        under = resting(limb.gravity, mass)
    else:
        # A thread pulls across the limb, whose own weight the plate carries.
        under = resting((0.0, -9.81e-3, 0.0), 1e3 * MASS)
    held = under - held_by * np.sign(under - before)
    hung = HungWeight.found(recorded(before, held), mass, AT)
    assert not hung.rows[:200].any()
    assert hung.rows[-300:-20].all()
    rubbing = with_segments(
        limb,
        friction_moment=lambda s: held_by * s.bending_stiffness / s.length,
        friction_curvature=lambda s: 0.1 / s.length,
    )
    change, deviation = hung.stiffness_change(limb, rubbing)
    assert np.exp(change) == pytest.approx(STIFFER, rel=0.08)
    assert np.all((deviation > 0.03) & (deviation < 0.2))


def test_what_was_not_hung_on_or_hardly_bends_is_named():
    none = np.zeros(2)
    with pytest.raises(LogError, match="hang on a heavier weight"):
        HungWeight.found(recorded(none, none + 0.01), MASS, AT)
    with pytest.raises(LogError, match="no 12 s without pressure"):
        HungWeight.found(recorded(none, none + 0.3, rest=5.0), MASS, AT)


def test_a_segment_that_friction_holds_tells_nothing():
    hung = HungWeight.found(recorded(np.zeros(2), np.array([-0.2, -0.04])), MASS, AT)
    rubbing = with_segments(
        LIMB,
        friction_moment=lambda s: 0.05 * s.bending_stiffness / s.length,
        friction_curvature=lambda s: 0.1 / s.length,
    )
    _, deviation = hung.stiffness_change(LIMB, rubbing)
    assert np.isfinite(deviation).tolist() == [True, False]


def test_a_weight_that_contradicts_the_motion_is_named():
    moved = [
        Unknown("log_stiffness[0]", "1", 0.0, 0.08),
        Unknown("friction[0]", "N m", 0.7, 0.1),
        Unknown("log_stiffness[1]", "1", 0.0, 0.5, untold=True),
    ]
    said = list(against_motion(moved, np.log([2.0, 2.0]), np.array([0.1, 0.1])))
    assert len(said) == 1
    assert "stiffness[0] is 2.00 times" in said[0]
    assert not list(against_motion(moved, np.log([1.3, 0.5]), np.array([0.1, 0.1])))
    assert not list(against_motion(moved, np.array([2.0, 2.0]), np.full(2, np.inf)))


def test_forces_count_by_the_stiffness_that_was_measured_and_else_by_the_fit_s():
    free = FreeTerms.of(LIMB, {"gain", "log_stiffness"})
    measured = free.told("log_stiffness", np.log([0.8, 1.0]), np.array([0.02, np.inf]))
    values = measured.at_places(values_of(LIMB))
    values[[term.name == "log_stiffness" for term in free.terms]] = np.log([1.1, 1.2])
    first, second = measured_stiffness(SimpleNamespace(free=measured), values)
    own = LIMB.segments[0].bending_stiffness
    assert first == pytest.approx(0.8 * own, rel=0.01)
    assert second == pytest.approx(1.2 * own)


def test_stiffness_is_found_though_friction_stops_each_swing():
    run, chain = calibration_run(16_800.0), LinkChain(1)
    log = chain.play(run.time, run.differential_pressure, run=1, noise=3.0).log()
    compliance = np.sum(1.0 / chain._stiffness.reshape(2, -1), axis=1)
    true = np.log(
        [s.length / c / s.bending_stiffness for s, c in zip(LIMB.segments, compliance, strict=True)]
    )
    change, deviation = stiffness_in_motion(LIMB, prepare(log, LIMB))
    assert deviation.max() < 0.1
    assert np.abs(change - true).max() < 0.12


AIR = replace(Limb.default().pneumatics, time_constant=0.3, vent_time_constant=0.12, delay=0.04)


def log_of(command: np.ndarray, measured: np.ndarray) -> CalibrationLog:
    blind = np.zeros_like(command)
    time = PERIOD * np.arange(len(command))
    return CalibrationLog(time, command, measured, blind, np.zeros((len(time), 2)))


def synthetic_log(air: Pneumatics, command: np.ndarray, noise: float = 5.0) -> CalibrationLog:
    """Pressures at the instants of the commands, by substeps ten times finer than the fit's."""
    held = Air(air).follow(command, PERIOD, 20).differential
    before = np.concatenate([np.zeros((1, command.shape[1])), held[:-1, -1]])
    measured = 0.5 * (before + held[:, 0])
    return log_of(command, measured + noise * np.random.default_rng(0).normal(size=command.shape))


def emulated_log(seed: int, command: np.ndarray) -> CalibrationLog:
    board = emulator.BoardPneumatics(command.shape[1], seed)
    measured = np.empty_like(command)
    for k, setpoint in enumerate(command):
        pressure = board.pressure
        measured[k] = pressure[0::2] - pressure[1::2]
        board.command(board.atmosphere + pair_of(setpoint).ravel())
        board.step(PERIOD)
    return log_of(command, measured)


def test_lag_of_the_air_is_recovered():
    air = replace(AIR, time_constant=0.32, vent_time_constant=0.14, delay=0.0)
    command = waves(12_000.0, 2, 60.0)
    log = synthetic_log(air, command, noise=0.0)
    found = fit_air(replace(log, measured_differential=log.measured_differential + 7.0), AIR)
    assert found.numbers["time_constant"] + found.numbers["delay"] == pytest.approx(0.32, abs=0.02)
    assert found.numbers["vent_time_constant"] + found.numbers["delay"] == pytest.approx(
        0.14, abs=0.02
    )
    np.testing.assert_allclose(found.offset, 7.0, atol=3.0)
    assert "vent_rate" not in found.numbers, "no outlet held a chamber up"
    with pytest.raises(LogError, match="tell nothing of their lag"):
        fit_air(replace(log, commanded_differential=log.measured_differential + 7.0), AIR)


@pytest.mark.parametrize(("rate", "exponent"), [(4200.0, 0.55), (5300.0, 2 / 3), (6500.0, 1.0)])
def test_law_of_venting_is_recovered_within_its_uncertainty(rate, exponent):
    air = replace(AIR, vent_rate=rate, vent_exponent=exponent)
    command = np.concatenate([waves(14_000.0, 2, 40.0), steps(7_000.0)])
    found = fit_air(synthetic_log(air, command), AIR)
    of_rate, of_exponent = (found.deviations[n] for n in ("vent_rate", "vent_exponent"))
    assert abs(found.numbers["vent_rate"] - rate) < 4 * of_rate + 0.01 * rate
    assert abs(found.numbers["vent_exponent"] - exponent) < 4 * of_exponent + 0.01
    assert of_rate < 0.02 * rate
    assert found.numbers["time_constant"] + found.numbers["delay"] == pytest.approx(0.34, abs=0.02)


def test_a_valve_that_opens_in_proportion_to_its_error_is_recognised():
    valve = {"vent_rate": 5000.0, "vent_exponent": 0.5, "vent_time_constant": 0.3}
    air = replace(AIR, vent_lag_exponent=0.5, **valve)
    command = np.concatenate([waves(14_000.0, 2, 40.0), steps(7_000.0)])
    found = fit_air(synthetic_log(air, command), AIR)
    assert found.numbers["vent_lag_exponent"] == pytest.approx(0.5, abs=0.05)
    assert found.numbers["vent_time_constant"] == pytest.approx(0.3, abs=0.03)
    assert found.residual < 15.0
    one_lag = fit_air(synthetic_log(replace(air, vent_lag_exponent=0.0), command), AIR)
    assert one_lag.numbers["vent_lag_exponent"] == 0.0
    assert one_lag.numbers["vent_time_constant"] == pytest.approx(0.3, abs=0.03)


def test_a_vented_step_of_the_emulated_board_is_predicted():
    """Whose law has chambers of their own, dead bands and coupled neighbours besides."""
    amplitude = 0.7 * Limb.default().pneumatics.pressure_limit
    run = calibration_run(amplitude, quick=True).differential_pressure
    found = fit_air(emulated_log(4, run), AIR)
    assert found.numbers["vent_exponent"] == pytest.approx(emulator.VENT_EXPONENT, abs=0.06)
    command = np.zeros((240, 2))
    command[20:120] = (7_000.0, -14_000.0)
    measured = emulated_log(4, command).measured_differential
    law = found.law(Limb.default().pneumatics)
    falling = slice(122, None)
    missed = {
        name: np.abs(Air(air).pressures_at_commands(command, PERIOD) - measured)[falling].max(
            axis=0
        )
        for name, air in {
            "law": law,
            "lag": replace(law, vent_rate=0.0),
            "exponential": replace(law, vent_exponent=1.0),
        }.items()
    }
    assert np.all(missed["law"] < 0.07 * np.array([7_000.0, 14_000.0]))
    assert np.all(missed["law"] < 0.15 * missed["lag"])
    assert np.all(missed["law"] < 0.6 * missed["exponential"])


@pytest.mark.parametrize(
    ("numbers", "said"),
    [
        ({"vent_rate": 5300.0, "vent_exponent": 0.66}, "5300 ± 31 Pa/s .* 0.66 ± 0.02"),
        ({}, "venting: not shown by this run, kept"),
    ],
)
def test_the_report_says_how_fast_chambers_vent_or_that_it_does_not_know(numbers, said):
    lags = {"time_constant": 0.3, "vent_time_constant": 0.1, "delay": 0.0}
    deviations = {"vent_rate": 31.0, "vent_exponent": 0.02}
    air = AirFit({**lags, **numbers}, deviations, 40.0, 9000.0)
    none, apart = np.zeros(0), np.zeros((0, 0))
    report = FitReport(Limb.default(), "", (), apart, air, None, none, none, none, none, 1.0, 1)
    assert re.search(said, report.text())
    assert numbers or "falls by" not in report.text()
