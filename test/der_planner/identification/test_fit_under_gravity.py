"""Fits of loaded limbs: a chain of links that is not ours, and refusals in place of tracebacks."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments
from link_chain import LinkChain

from der_planner.estimation.free_level import FreeLevel
from der_planner.identification import CalibrationLog, LogError, fit, predict
from der_planner.identification.bends import NODES, Predicted
from der_planner.identification.excitation import sweep, waves
from der_planner.identification.lengths import (
    GivesWayError,
    uneven_tip,
    uneven_tips,
    unevenness,
    with_lengths,
)
from der_planner.identification.log import Prepared
from der_planner.identification.terms import FreeTerms
from der_planner.limb import Limb, PointMass, gravity_of
from der_planner.model import RodModel, simulate

pytestmark = pytest.mark.slow

TERMS = ("asymmetry", "friction", "dynamics")


def prior(gravity, masses=()) -> Limb:
    """Return what is known of a chain before it is calibrated: the default limb, its loads."""
    limb = replace(Limb.default(), gravity=gravity)
    for at, mass in masses:
        limb = limb.carrying(mass, at)
    return limb


def chain_log(
    gravity, masses=(), swing=(0.0, 0.0), seed=5, amplitude=14_000.0, duration=15.0
) -> CalibrationLog:
    pressure = np.concatenate([waves(amplitude, 2, duration), sweep(3500.0, 2, 6.0)])
    time = 0.05 * np.arange(len(pressure))
    played = LinkChain(seed, gravity, masses).play(time, pressure, 20.0, run=1, swing=swing)
    return played.log()


def logged(time, pressure, bend_angles, tip) -> Prepared:
    """Return a log without gaps as `prepare` gives it."""
    log = CalibrationLog(time, pressure, pressure, bend_angles, tip)
    return Prepared(log, pressure, bend_angles, np.ones(len(time), bool), ())


def test_a_chain_held_sideways_that_swings_and_carries_a_mass_is_fitted():
    gravity, masses = gravity_of("sideways"), ((0.244, 0.02),)
    chain = LinkChain(1, gravity, masses)
    log = chain_log(gravity, masses, swing=(3.0, -5.0), seed=1, duration=20.0)
    limb, report = fit(prior(gravity, masses), log, terms=TERMS)
    assert any("begins while the limb swings" in warning for warning in report.warnings)
    assert np.degrees(report.residual).max() < 0.7
    # The weight tells the stiffness of the first segment, which bears it. The swing of this chain
    # is stiffer than its rest, by its friction: a fit that took one for the other found 1.4 times
    # the stiffness and a rest angle that was off by 12°.
    first, known = limb.segments[0], report.value("log_stiffness[0]")
    truth = 0.122 / np.sum(1.0 / chain._stiffness[:7])
    assert known.deviation < 0.09
    assert first.bending_stiffness == pytest.approx(truth, rel=0.12)
    assert f"{np.exp(known.value):.3f} × the prior's" in report.text()
    rest = first.rest_curvature * first.length
    assert np.degrees(rest) == pytest.approx(np.degrees(chain._rest[0]), abs=4.0)
    assert first.swing_inertia < 0.95
    assert "cannot tell log_stiffness[0] and rest_angle[0] apart" in report.text()
    # The lengths do not take up that a heavy limb bends unevenly.
    assert limb.length == pytest.approx(0.244, abs=4e-3)
    assert limb.masses[0].arc_length == pytest.approx(limb.length)
    unseen = chain.play(log.time, 0.8 * log.commanded_differential[::-1], 20.0, noise=0.0)
    tip = predict(limb, unseen.time, unseen.measured_differential).tip
    assert np.linalg.norm(tip - unseen.tip, axis=1).mean() < 0.004


def test_lengths_that_are_far_off_are_named_in_place_of_a_traceback():
    limb = Limb.default().mounted("hanging")
    long = with_segments(limb, length=lambda s: 1.35 * s.length)
    pressure = waves(12_000.0, 2, 12.0)
    time = 0.05 * np.arange(len(pressure))
    log = LinkChain(3, gravity_of("hanging")).play(time, pressure, 20.0).log()
    found, report = fit(long, log, terms=())
    # Tips that are where no bend puts them are no touch.
    assert FreeLevel(found).noise[-1] > 0.99 * report.geometry.residual**2
    assert "segment 1 is given as 165 mm and was found to be 132 mm or less" in report.text()
    assert "limb file of --prior" in report.text()
    for factor, shift in ((1000.0, 0.0), (0.01, 0.0), (1.0, 0.4)):
        with pytest.raises(LogError, match=r"check the tips' unit .* and origin"):
            fit(limb, replace(log, tip=factor * log.tip + shift), terms=())


def test_tips_tell_how_much_of_a_bend_is_the_weights():
    limb = with_lengths(Limb.default().mounted("sideways"), np.array([0.12, 0.12, 1e-3, 4e-3]))
    pressure = waves(16_800.0, 2, 15.0)
    time = 0.05 * np.arange(len(pressure))
    model, fine = RodModel(limb, NODES), RodModel(limb)
    seen = simulate(fine, time, pressures=pressure)
    log = logged(time, pressure, seen.bend_angles, seen.tip)
    coarse = simulate(model, time, pressures=pressure)
    finer = seen.tip - fine.kinematics.tip(seen.bend_angles)
    finer -= coarse.tip - model.kinematics.tip(coarse.bend_angles)
    # Lengths that are wrong by some millimetres are no reason to find another stiffness.
    other = RodModel(with_lengths(limb, np.array([0.117, 0.125, 0.003, 0.004])), NODES)
    tips = uneven_tips(limb, other, log, finer)
    stiffness = FreeTerms.of(other.limb, {"log_stiffness"})

    def rows(change: float) -> tuple[np.ndarray, np.ndarray]:
        residual, slopes = tips(Predicted(stiffness, other, log, np.array([0.0, change])))
        return residual[:-4], slopes()[:-4]  # the last ones are what is known of the lengths

    own = np.linalg.norm(rows(0.0)[0])
    assert np.linalg.norm(rows(-0.3)[0]) > 2.5 * own
    assert np.linalg.norm(rows(0.3)[0]) > 2.5 * own
    slope = rows(0.0)[1][:, 1]
    difference = (rows(0.02)[0] - rows(-0.02)[0]) / 0.04
    assert np.abs(slope - difference).max() < 0.05 * np.abs(difference).max()


def test_a_limb_that_gives_way_in_the_rod_of_the_planners_is_refused():
    known = Limb.default().mounted("sideways")
    time = 0.05 * np.arange(120)
    pressure = np.minimum(time / 3.0, 1.0)[:, None] * np.array([-20e3, -20e3])

    def softening(growth: float) -> Limb:
        return with_segments(known, bending_stiffness=0.0183, cubic_stiffness=growth, damping=0.7)

    none = np.zeros_like(pressure)
    log = logged(time, pressure, none, none)
    whole, lacking = unevenness(softening(-1.0e-5), log, NODES)
    assert 0.0 < np.abs(lacking).max() < 0.2 * np.abs(whole).max()
    assert np.isfinite(uneven_tip(softening(-1.6e-5), log, NODES)).all()
    with pytest.raises(GivesWayError, match="smaller pressures"):
        unevenness(softening(-1.6e-5), log, NODES)


def test_the_cubic_term_is_left_out_where_the_limb_gives_way_with_it(monkeypatch):
    gravity = gravity_of("sideways")
    log = chain_log(gravity, seed=1)

    def softer(limb: Limb, log: Prepared, nodes: int) -> tuple[np.ndarray, np.ndarray]:
        if any(segment.cubic_stiffness for segment in limb.segments):
            raise GivesWayError("gives way")
        return unevenness(limb, log, nodes)

    monkeypatch.setattr(sys.modules["der_planner.identification.fit"], "unevenness", softer)
    limb, report = fit(prior(gravity), log, terms=(*TERMS, "cubic"))
    assert not any(segment.cubic_stiffness for segment in limb.segments)
    assert any("cubic term is left out" in warning for warning in report.warnings)
    assert np.degrees(report.residual).max() < 0.7


def test_mass_is_told_where_stiffness_is_given():
    chain = LinkChain(2, (0.0, -1.7, 0.0))
    stiffness = [0.122 / np.sum(1.0 / part) for part in chain._stiffness.reshape(2, 7)]
    known = prior((0.0, -1.7, 0.0))
    heavier = with_segments(known, mass_per_length=lambda s: 1.25 * s.mass_per_length)
    heavy = with_segments(heavier, bending_stiffness=[float(each) for each in stiffness])
    limb, report = fit(heavy, chain_log((0.0, -1.7, 0.0), seed=2), terms=(*TERMS, "mass"))
    assert [s.bending_stiffness for s in limb.segments] == pytest.approx(stiffness)
    assert limb.moving_mass == pytest.approx(1.066 * 0.244, rel=0.1)
    moment = re.search(r"first moment ([0-9.]+) g·m", report.text())
    assert float(moment[1]) == pytest.approx(1066 * 0.244**2 / 2, rel=0.1)


def test_a_prior_that_its_rod_cannot_follow_is_refused_by_name():
    log = chain_log((0.0, 0.0, 0.0), amplitude=9000.0)
    rows = log.between(0.0, 6.0)
    heavy = replace(prior((-9.81, 0.0, 0.0)), masses=(PointMass(0.244, 1e4),))
    with pytest.raises(LogError, match="check the prior's gravity, mass"):
        fit(heavy, rows, terms=())
    with pytest.raises(LogError, match="cannot follow this log"):
        predict(heavy, rows.time, rows.measured_differential)
