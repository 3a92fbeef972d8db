"""Stiffness from a known weight on the resting limb, whatever friction does, and from motion."""

from dataclasses import replace

import numpy as np
import pytest
from limbs import with_segments
from link_chain import LinkChain

from der_planner.identification import CalibrationLog, LogError
from der_planner.identification.excitation import calibration_run
from der_planner.identification.log import Prepared, prepare
from der_planner.identification.report import Unknown
from der_planner.identification.stiffness import HungWeight, stiffness_in_motion
from der_planner.identification.told import against_motion
from der_planner.limb import Limb, PointMass
from der_planner.model import RodModel

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
